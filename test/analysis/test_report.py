# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The report page: self-contained, well-formed, with all peaks and a list of missing data."""

from html.parser import HTMLParser
import json
import re
from xml.etree import ElementTree

from fourbar_ros.analysis import report
from fourbar_ros.common.config_files import ConfigurationError
from fourbar_ros.common.output_files import OutputError
from fourbar_ros.mechanism import Mechanism
from fourbar_ros.plotting import style
import numpy as np
import pytest

pytestmark = pytest.mark.medium

FOUR = np.ones(4)
PAPER = Mechanism(
    0.1 * FOUR, 0.02 * FOUR, 2.2e-5 * FOUR, np.tile([0.05, 0.0], (4, 1)), 3.4e-7 * FOUR)
NAMES = [name for name, _, _ in report.SECTIONS]


@pytest.fixture(scope='module')
def written(motion_bag, tmp_path_factory):
    folder = tmp_path_factory.mktemp('report')
    result = report.write_report(motion_bag, folder / 'r.html', folder / 'm.json', PAPER)
    return result, (folder / 'r.html').read_text(), (folder / 'm.json').read_text()


def figures(page):
    """Return the SVG elements of the page by the section they are in."""
    return {name: ElementTree.fromstring(svg) for name, svg in re.findall(
        r'<section id="(\w+)"><h2>[^<]*</h2><figure>(<svg.*?</svg>)', page, re.DOTALL)}


@pytest.mark.slow
def test_page_and_json_have_the_same_numbers(written):
    result, page, text = written
    assert json.loads(text) == result
    for group in ('tracking', 'estimate', 'flywheel', 'energy', 'loop'):
        for key, value in result[group].items():
            row = re.search(rf'<code>{group}\.{key}</code>.*?"number">([^<]+)<', page, re.DOTALL)
            assert float(row[1]) == pytest.approx(value, rel=1e-3)


def test_every_figure_is_drawn_and_well_formed(written):
    assert list(figures(written[1])) == NAMES


def test_page_is_self_contained(written):
    page = written[1]
    outside = re.sub(r'xmlns(:\w+)?="[^"]*"', '', page)
    assert not re.search(r'https?:|<link|<script|@import|url\((?!#)|src=', outside)


def test_identifiers_are_unique_and_found(written):
    page = written[1]
    defined = re.findall(r'\bid="([^"]+)"', page)
    assert len(defined) == len(set(defined))
    used = re.findall(r'href="#([^"]+)"', page) + re.findall(r'url\(#([^)]+)\)', page)
    assert set(used) <= set(defined)


def test_every_colour_has_a_dark_variant(written):
    page = written[1]
    sheet, body = page.split('</style>', 1)
    light, dark = sheet.split('prefers-color-scheme: dark')
    for name in set(re.findall(r'var\(--([\w-]+)\)', page)):
        assert f'--{name}:' in light
        assert f'--{name}:' in dark
    assert not re.findall(r'(?:fill|stroke): (#(?!0{3,6})\w+)', body)


def contrast(one, other):
    """Return the contrast ratio of two colours as WCAG 2 defines it."""
    def luminance(colour):
        channels = [int(colour[place:place + 2], 16) / 255 for place in (1, 3, 5)]
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055)**2.4 for c in channels]
        return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))
    bright, dim = sorted((luminance(one), luminance(other)), reverse=True)
    return (bright + 0.05) / (dim + 0.05)


@pytest.mark.parametrize('paper', [0, 1], ids=['light', 'dark'])
@pytest.mark.parametrize('name', ['ink', 'muted', 'limit', 'link_a', 'link_b', 'link_c', 'link_d'])
def test_text_and_curves_have_contrast(name, paper):
    # WCAG AA requires 4.5 for text; the link colours are used for text too.
    assert contrast(style.PALETTE[name][paper], style.PALETTE['paper'][paper]) >= 4.0


def test_tags_are_balanced(written):
    class Balance(HTMLParser):
        stack = []

        def handle_starttag(self, tag, attrs):
            if tag not in ('meta', 'br'):
                self.stack.append(tag)

        def handle_startendtag(self, tag, attrs):
            pass

        def handle_endtag(self, tag):
            assert self.stack.pop() == tag

    parser = Balance()
    parser.feed(written[1])
    assert parser.stack == []


@pytest.mark.slow
def test_size_does_not_grow_with_the_recording(synthetic, tmp_path):
    bag = synthetic.write_bag(tmp_path / 'bag', synthetic.motion_messages(rate_hz=250))
    report.write_report(bag, tmp_path / 'r.html', tmp_path / 'm.json', PAPER)
    assert (tmp_path / 'r.html').stat().st_size < 3e6


@pytest.mark.parametrize('thin', [lambda x, y: style.decimate(x, y, 100),
                                  lambda x, y: style.thin_out(x, y, 400)])
def test_thinning_keeps_every_peak(thin):
    rng = np.random.default_rng(0)
    x = np.arange(50_000.0)
    y = rng.standard_normal(50_000)
    y[31_415], y[27_182], y[100] = 50.0, -50.0, np.nan

    kept_x, kept_y = thin(x, y)

    assert len(kept_x) <= 500
    assert np.all(np.diff(kept_x) > 0)
    assert (kept_y.max(), kept_y.min()) == (50.0, -50.0)
    assert np.array_equal(y[kept_x.astype(int)], kept_y)


@pytest.mark.slow
@pytest.mark.parametrize(('topics', 'absent'), [
    (['timing'], {'timing'}),
    (['estimate/innovation'], {'innovations'}),
    (['estimate/sigma', 'link_angles', 'controller_status'], set()),
    (['sim/link_states', 'sim/flywheel_states', 'energy'], {'energy'}),
])
def test_missing_data_is_named_in_the_page(synthetic, tmp_path, topics, absent):
    messages = synthetic.motion_messages()
    for topic in topics:
        del messages[f'/{topic}']
    bag = synthetic.write_bag(tmp_path / 'bag', messages)
    report.write_report(bag, tmp_path / 'r.html', tmp_path / 'm.json', PAPER)
    page = (tmp_path / 'r.html').read_text()
    assert set(figures(page)) == set(NAMES) - absent
    assert set(re.findall(r'<section id="(\w+)"><h2>[^<]*</h2><p class="absent">', page)) == absent


@pytest.mark.slow
def test_motion_backwards_short_and_cut(synthetic, tmp_path):
    messages = synthetic.motion_messages()
    for name, entries in messages.items():
        messages[name] = entries[:200]
        for _, message in messages[name]:
            if name.endswith(('link_states', 'reference', 'setpoint', 'link_angles')):
                message.position *= -1
    bag = synthetic.write_bag(tmp_path / 'bag', messages)
    result = report.write_report(bag, tmp_path / 'r.html', tmp_path / 'm.json', PAPER)
    assert not result['motion']['complete']
    assert list(figures((tmp_path / 'r.html').read_text())) == NAMES


@pytest.mark.slow
def test_unknown_mechanism_of_the_bag_is_ignored_and_of_the_caller_refused(synthetic, tmp_path):
    bag = synthetic.write_bag(
        tmp_path / 'bag', synthetic.motion_messages(mechanism='/gone/my.yaml'))
    files = tmp_path / 'r.html', tmp_path / 'm.json'
    assert 'flywheel.peak_energy_j' in report.write_report(bag, *files)['missing']
    with pytest.raises(ConfigurationError):
        report.write_report(bag, *files, 'nowhere')


@pytest.mark.slow
def test_output_that_cannot_be_written_is_an_error(motion_bag, tmp_path):
    with pytest.raises(OutputError):
        report.write_report(motion_bag, tmp_path / 'no' / 'r.html', tmp_path / 'm.json', PAPER)
