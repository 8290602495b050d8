# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One self-contained HTML page and one JSON file from a bag."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from functools import partial
import html as markup
import json
from pathlib import Path
from typing import Any

from fourbar_ros.analysis.bags import BagError, read_bag, Recording
from fourbar_ros.analysis.manoeuvre import find_motion
from fourbar_ros.analysis.metrics import MEANINGS, metrics
from fourbar_ros.common import names
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.progress import Progress
from fourbar_ros.mechanism import load_mechanism, Mechanism
import numpy as np


class ReportError(FourbarError):
    """A report that cannot be written."""


# Name of the figure function, heading, what to see in it.
SECTIONS = (
    ('linkage', 'The motion',
     'Seen from above the table at equal intervals of the step, the mass centre of the whole '
     'linkage (+) at the origin; dashed: the goal. The arc around each wheel is its absolute '
     'speed, counter-clockwise from the top, as a share of the largest in this motion.'),
    ('angles', 'Link angles',
     'The insets magnify 0.2 s at the middle of the step. Dotted verticals, here and below: '
     'setpoint and end of the step.'),
    ('errors', 'Tracking and estimate errors',
     'Above, how far links a and b are from the reference: coloured in truth, grey as the '
     'controller sees it. Below, how wrong the estimate is, over the band of two standard '
     'deviations that the filter itself claims: 95 % should lie '
     'inside. Without ground truth in the bag, only what the controller sees.'),
    ('wheels', 'Flywheels',
     'Opposite wheels carry the same load in a parallelogram: dashed curves (c, d) lie on solid '
     'ones (a, b). Speeds that do not return to zero are momentum that friction has moved.'),
    ('energy', 'Energy',
     'Kinetic energy of the wheels from their absolute speeds, the integral of the paper (unit '
     'J s, so not an energy), and the mechanical work of the motors.'),
    ('timing', 'Loop timing',
     'Time between a tick and the command that answers it, measured by the device on a steady '
     'clock. Solid line: median; dashed: 99th percentile; red: control period.'),
    ('innovations', 'Filter consistency',
     'Innovations should scatter about zero without a trend. The mean should stay in the '
     'band: above it the filter trusts itself too much, below it too little.'),
)

# Name, label and how to show it.
TILES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ('tracking.rms_rad', 'tracking error, rms', lambda v: f'{np.degrees(v):.3g}°'),
    ('tracking.final_error_rad', 'final error', lambda v: f'{np.degrees(v):.3g}°'),
    ('estimate.rms_error_rad', 'estimate error, rms', lambda v: f'{np.degrees(v):.3g}°'),
    ('flywheel.peak_speed_rad_s', 'peak wheel speed', lambda v: f'{v:.3g} <small>rad/s</small>'),
    ('loop.round_trip_p99_ms', 'round trip, 99 %', lambda v: f'{v:.3g} <small>ms</small>'),
    ('loop.lost', 'lost ticks', lambda v: f'{v:d}'),
)
# Without ground truth the estimate has to do.
FALLBACKS = {
    'tracking.rms_rad': 'tracking.estimated_rms_rad',
    'tracking.final_error_rad': 'tracking.estimated_final_error_rad',
    'flywheel.peak_speed_rad_s': 'flywheel.measured_peak_speed_rad_s',
}


def write_report(bag: str | Path, html: str | Path, metrics_json: str | Path,
                 mechanism: Mechanism | str | None = None, *, namespace: str | None = None,
                 progress: Progress | None = None) -> dict[str, Any]:
    """
    Read a bag, write the page and the metrics.

    :param mechanism: a preset, a file, or the mechanism itself; None: the one the bag names.
    :param namespace: of the suite, for a bag that holds more than one.
    :param progress: wraps each iterable that takes time, given also its length.
    :returns: the metrics, as in the JSON file.
    :raises FourbarError: a bad bag, an unknown mechanism, or files that cannot be written.
    """
    recording = read_bag(bag, namespace, progress)
    if isinstance(mechanism, str):
        mechanism = load_mechanism(mechanism)
    used = mechanism or _recorded_mechanism(recording)
    result = {'bag': recording.path.absolute().name, **metrics(recording, used)}
    page = make_page(recording, used, result, progress)
    _write(Path(metrics_json), json.dumps(result, indent=2, allow_nan=False) + '\n')
    _write(Path(html), page)
    return result


def _recorded_mechanism(recording: Recording) -> Mechanism | None:
    """Return the mechanism that the device named, None if it did not or it is not here."""
    if recording.has(names.DEVICE_STATUS):
        for status in reversed(recording.statuses(names.DEVICE_STATUS)):
            if name := status.values.get('mechanism'):
                try:
                    return load_mechanism(name)
                except FourbarError:
                    return None
    return None


def _write(path: Path, text: str) -> None:
    try:
        path.write_text(text, encoding='utf-8')
    except OSError as error:
        raise ReportError(f'cannot write {path}: {error.strerror}') from error


def make_page(recording: Recording, mechanism: Mechanism | None, result: dict[str, Any],
              progress: Progress | None = None) -> str:
    """Return the HTML page for the metrics of a recording."""
    from fourbar_ros.analysis import report_figures as figures
    from fourbar_ros.plotting import style

    view = figures.View(recording, find_motion(recording), mechanism)
    parts = []
    for name, heading, caption in progress(SECTIONS, len(SECTIONS)) if progress else SECTIONS:
        try:
            drawing = style.draw(partial(getattr(figures, name), view), name)
            body = f'<figure>{drawing}<figcaption>{_text(caption)}</figcaption></figure>'
        except BagError as error:
            body = f'<p class="absent">Not in this report: {_text(error)}.</p>'
        parts.append(f'<section id="{name}"><h2>{heading}</h2>{body}</section>')
    title = f'{result["bag"]}: motion report'
    return _PAGE.format(
        title=_text(title), style=_style_sheet(style.PALETTE), summary=_summary(recording, result),
        tiles=_tiles(result), figures='\n'.join(parts), table=_table(result),
        topics=_topics(recording))


def _text(value: object) -> str:
    return markup.escape(str(value))


def _value(result: dict[str, Any], name: str) -> Any:
    group, _, key = name.partition('.')
    return result.get(group, {}).get(key)


def _summary(recording: Recording, result: dict[str, Any]) -> str:
    motion = result['motion']
    began = datetime.fromtimestamp(recording.started_ns * 1e-9).astimezone()
    goal = ', '.join(f'{name.replace("_", " ")} to {np.degrees(motion["goal_rad"][name]):.4g}°'
                     for name in ('link_a', 'link_b') if name in motion['goal_rad'])
    which = (f' (setpoint {motion["setpoint_number"]} of {motion["setpoint_count"]})'
             if motion['setpoint_count'] > 1 else '')
    cut = '' if motion['complete'] else ' The recording ends before the step does.'
    return _text(
        f'{goal} in {motion["setpoint_duration_s"]:.4g} s{which}. Recorded '
        f'{began:%Y-%m-%d %H:%M:%S %Z}: {recording.duration_s:.1f} s, '
        f'{recording.message_count} messages of {len(recording.topics)} topics.{cut}')


def _tiles(result: dict[str, Any]) -> str:
    tiles = []
    for name, label, show in TILES:
        value = _value(result, name)
        if value is None and name in FALLBACKS:
            how = FALLBACKS[name].partition('.')[2].partition('_')[0]
            value, label = _value(result, FALLBACKS[name]), f'{label} ({how})'
        if value is not None:
            tiles.append(f'<div><b>{show(value)}</b><span>{label}</span></div>')
    return ''.join(tiles)


def _table(result: dict[str, Any]) -> str:
    rows = []
    for name, meaning in MEANINGS.items():
        value = _value(result, name)
        if value is None:
            reason = result['missing'].get(name, '')
            number = f'<span title="{_text(reason)}">missing</span>'
        else:
            number = f'{value:d}' if isinstance(value, int) else f'{value:.4g}'
            if meaning.unit == 'rad':
                number += f'<small>{np.degrees(value):.3g}°</small>'
        unit = '' if meaning.unit == '1' else meaning.unit
        rows.append(f'<tr><td><code>{name}</code><p>{_text(meaning.sentence)}</p></td>'
                    f'<td class="number">{number}</td><td>{unit}</td></tr>')
    return ''.join(rows)


def _topics(recording: Recording) -> str:
    return ''.join(
        f'<tr><td><code>{_text(topic)}</code></td><td>{_text(type_name)}</td>'
        f'<td class="number">{recording.counts[topic]}</td></tr>'
        for topic, type_name in sorted(recording.topics.items()))


def _style_sheet(palette: dict[str, tuple[str, str]]) -> str:
    def variables(index: int) -> str:
        return ' '.join(f'--{name.replace("_", "-")}: {colours[index]};'
                        for name, colours in palette.items())

    return (f':root {{ color-scheme: light dark; {variables(0)} }}\n'
            f'@media (prefers-color-scheme: dark) {{ :root {{ {variables(1)} }} }}\n{_LAYOUT}')


_LAYOUT = """\
body { margin: 0; background: var(--paper); color: var(--ink);
  font: 16px/1.5 system-ui, 'Segoe UI', Roboto, 'DejaVu Sans', sans-serif; }
main { max-width: 62rem; margin: 0 auto; padding: 2rem 1.25rem 4rem; }
h1 { font-size: 1.6rem; line-height: 1.2; margin: 0 0 .4rem; overflow-wrap: anywhere; }
h2 { font-size: 1.15rem; margin: 2.6rem 0 .6rem; }
.summary, figcaption, td p, .tiles span { color: var(--muted); }
.summary { margin: 0 0 1.4rem; }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .6rem; }
.tiles div { background: var(--tile); border-radius: .5rem; padding: .7rem .9rem; }
.tiles b { display: block; font-size: 1.3rem; font-variant-numeric: tabular-nums; }
.tiles small { font-size: .95rem; font-weight: 500; }
.tiles span { font-size: .82rem; }
figure { margin: 0; }
svg { display: block; width: 100%; height: auto; }
svg text { font-family: inherit !important; }
figcaption { font-size: .88rem; margin-top: .5rem; max-width: 52rem; }
.absent { color: var(--muted); font-style: italic; overflow-wrap: anywhere; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; }
td, th { text-align: left; padding: .45rem .8rem .45rem 0; vertical-align: top;
  border-bottom: 1px solid var(--grid); }
th { color: var(--muted); font-weight: 500; }
td p { margin: .1rem 0 0; font-size: .84rem; }
td.number { text-align: right; white-space: nowrap; font-variant-numeric: tabular-nums; }
td.number small { display: block; color: var(--muted); }
summary { cursor: pointer; font-weight: 600; margin-top: 2.6rem; }
code { font-size: .86em; }
"""

_PAGE = """\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
{style}</style>
</head>
<body>
<main>
<h1>{title}</h1>
<p class="summary">{summary}</p>
<div class="tiles">{tiles}</div>
{figures}
<section id="metrics"><h2>All metrics</h2>
<table><tr><th>metric</th><th>value</th><th>unit</th></tr>{table}</table></section>
<details><summary>Topics in the bag</summary>
<table><tr><th>topic</th><th>type</th><th>messages</th></tr>{topics}</table></details>
</main>
</body>
</html>
"""
