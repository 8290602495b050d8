# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""One self-contained HTML page and one JSON file of metrics from a bag."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from functools import partial
import html as markup
import json
from pathlib import Path
from string import Template
from typing import Any

from fourbar_ros.analysis.bag_reader import BagError
from fourbar_ros.analysis.bags import Bag, read_bag
from fourbar_ros.analysis.manoeuvre import find_manoeuvre
from fourbar_ros.analysis.metrics import compute_metrics, METRICS
from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.names import DEVICE_STATUS
from fourbar_ros.common.output_files import write_files
from fourbar_ros.common.progress import no_progress, Progress
from fourbar_ros.mechanism import load_mechanism, Mechanism
import numpy as np

TEMPLATE = Path(__file__).with_name('report.html')

# Name of the figure function, heading, caption.
SECTIONS = (
    ('linkage', 'The motion',
     'Top view of the linkage at equal intervals of the step, with its centre of mass (+) at the '
     'origin; dashed: the goal. The arc around each wheel is its absolute speed, '
     'counter-clockwise from the top, as a fraction of the largest speed in this motion.'),
    ('angles', 'Link angles',
     'The insets magnify 0.2 s at the middle of the step. Dotted vertical lines, here and below: '
     'setpoint and end of the step.'),
    ('errors', 'Tracking and estimate errors',
     'Top: tracking error of links a and b; coloured: ground truth, grey: the estimate that the '
     'controller uses. Below: estimate error, and the band of two standard deviations of the '
     "filter's covariance, which contains 95 % of the errors of a consistent filter. Without "
     'ground truth in the bag only the tracking error of the estimate is shown.'),
    ('wheels', 'Flywheels',
     'Opposite wheels carry equal loads in a parallelogram: dashed curves (c, d) cover solid '
     'ones (a, b). A speed that does not return to zero is momentum transferred by friction.'),
    ('energy', 'Energy',
     'Kinetic energy of the wheels from their absolute speeds (paper eq. 7), the integral of '
     'paper eq. 9 (unit J s, so not an energy), and the mechanical work of the motors.'),
    ('timing', 'Loop timing',
     'Time between a tick and the command that answers it, measured by the device with a '
     'monotonic clock. Solid line: median; dashed: 99th percentile; red: control period.'),
    ('innovations', 'Filter consistency',
     'Innovations of a consistent filter are white with zero mean. The mean NIS should stay in '
     'the band: above it the covariance of the filter is too small, below it too large.'),
)


def _degrees(value: float) -> str:
    return f'{np.degrees(value):.3g}°'


# Metric, label, and format of each number at the top of the page.
TILES: tuple[tuple[str, str, Callable[[float], str]], ...] = (
    ('tracking.rms_rad', 'tracking error, rms', _degrees),
    ('tracking.final_error_rad', 'final error', _degrees),
    ('estimate.rms_error_rad', 'estimate error, rms', _degrees),
    ('flywheel.peak_speed_rad_s', 'peak wheel speed', lambda v: f'{v:.3g} <small>rad/s</small>'),
    ('loop.round_trip_p99_ms', 'round trip, 99 %', lambda v: f'{v:.3g} <small>ms</small>'),
    ('loop.lost', 'lost ticks', lambda v: f'{v:d}'),
)

# Metric in place of one that needs ground truth.
FALLBACKS = {
    'tracking.rms_rad': 'tracking.estimated_rms_rad',
    'tracking.final_error_rad': 'tracking.estimated_final_error_rad',
    'flywheel.peak_speed_rad_s': 'flywheel.measured_peak_speed_rad_s',
}


def write_report(bag: str | Path, html: str | Path, metrics_json: str | Path,
                 mechanism: Mechanism | str | None = None, *, namespace: str | None = None,
                 progress: Progress = no_progress) -> dict[str, Any]:
    """
    Read a bag, and write the page and the metrics.

    :param mechanism: a preset, a file, or the mechanism itself; None: the one named in the bag.
    :param namespace: of the suite, for a bag with more than one.
    :param progress: wraps each iterable of long work.
    :returns: the metrics, as in the JSON file.
    :raises FourbarError: a bad bag, an unknown mechanism, or files that cannot be written.
    """
    recorded = read_bag(bag, namespace, progress)
    if isinstance(mechanism, str):
        mechanism = load_mechanism(mechanism)
    used = mechanism or _recorded_mechanism(recorded)
    result = {'bag': recorded.path.absolute().name, **compute_metrics(recorded, used)}
    write_files({
        Path(metrics_json): json.dumps(result, indent=2, allow_nan=False) + '\n',
        Path(html): make_page(recorded, used, result, progress)})
    return result


def _recorded_mechanism(bag: Bag) -> Mechanism | None:
    """Return the mechanism that the device named, None if it is unknown here."""
    try:
        return load_mechanism(bag.last_status(DEVICE_STATUS, 'mechanism'))
    except FourbarError:
        return None


def make_page(bag: Bag, mechanism: Mechanism | None, result: dict[str, Any],
              progress: Progress = no_progress) -> str:
    """Return the HTML page for the metrics of a bag."""
    from fourbar_ros.analysis import report_figures as figures
    from fourbar_ros.plotting import style

    data = figures.ReportData(find_manoeuvre(bag), mechanism)
    parts = []
    for name, heading, caption in progress(SECTIONS, len(SECTIONS)):
        try:
            drawing = style.page_svg(partial(getattr(figures, name), data), name)
            body = f'<figure>{drawing}<figcaption>{_text(caption)}</figcaption></figure>'
        except BagError as error:
            body = f'<p class="absent">Not in this report: {_text(error)}.</p>'
        parts.append(f'<section id="{name}"><h2>{heading}</h2>{body}</section>')
    title = f'{result["bag"]}: motion report'
    return Template(TEMPLATE.read_text(encoding='utf-8')).substitute(
        title=_text(title), colours=_colours(style.PALETTE), summary=_summary(bag, result),
        tiles=_tiles(result), figures='\n'.join(parts), table=_table(result),
        topics=_topics(bag))


def _text(value: object) -> str:
    return markup.escape(str(value))


def _value(result: dict[str, Any], name: str) -> Any:
    group, _, key = name.partition('.')
    return result.get(group, {}).get(key)


def _summary(bag: Bag, result: dict[str, Any]) -> str:
    motion = result['motion']
    began = datetime.fromtimestamp(bag.started_ns * 1e-9).astimezone()
    goal = ', '.join(f'{name.replace("_", " ")} to {np.degrees(motion["goal_rad"][name]):.4g}°'
                     for name in ('link_a', 'link_b') if name in motion['goal_rad'])
    which = (f' (setpoint {motion["setpoint_number"]} of {motion["setpoint_count"]})'
             if motion['setpoint_count'] > 1 else '')
    cut = '' if motion['complete'] else ' The recording ends before the step does.'
    return _text(
        f'{goal} in {motion["setpoint_duration_s"]:.4g} s{which}. Recorded '
        f'{began:%Y-%m-%d %H:%M:%S %Z}: {bag.duration_s:.1f} s, '
        f'{bag.message_count} messages of {len(bag.topics)} topics.{cut}')


def _tiles(result: dict[str, Any]) -> str:
    tiles = []
    for name, label, write in TILES:
        value = _value(result, name)
        if value is None and name in FALLBACKS:
            source = FALLBACKS[name].partition('.')[2].partition('_')[0]
            value, label = _value(result, FALLBACKS[name]), f'{label} ({source})'
        if value is not None:
            tiles.append(f'<div><b>{write(value)}</b><span>{label}</span></div>')
    return ''.join(tiles)


def _table(result: dict[str, Any]) -> str:
    rows = []
    for name, description in METRICS.items():
        value = _value(result, name)
        if value is None:
            reason = result['missing'].get(name, '')
            number = f'<span title="{_text(reason)}">missing</span>'
        else:
            number = f'{value:d}' if isinstance(value, int) else f'{value:.4g}'
            if description.unit == 'rad':
                number += f'<small>{np.degrees(value):.3g}°</small>'
        unit = '' if description.unit == '1' else description.unit
        rows.append(f'<tr><td><code>{name}</code><p>{_text(description.meaning)}</p></td>'
                    f'<td class="number">{number}</td><td>{unit}</td></tr>')
    return ''.join(rows)


def _topics(bag: Bag) -> str:
    return ''.join(
        f'<tr><td><code>{_text(topic)}</code></td><td>{_text(type_name)}</td>'
        f'<td class="number">{bag.counts[topic]}</td></tr>'
        for topic, type_name in sorted(bag.topics.items()))


def _colours(palette: dict[str, tuple[str, str]]) -> str:
    """Return the CSS variables of the palette, for light and dark backgrounds."""
    def variables(index: int) -> str:
        return ' '.join(f'--{name.replace("_", "-")}: {colours[index]};'
                        for name, colours in palette.items())

    return (f':root {{ color-scheme: light dark; {variables(0)} }}\n'
            f'@media (prefers-color-scheme: dark) {{ :root {{ {variables(1)} }} }}')
