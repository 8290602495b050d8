# Copyright 2026 The fourbar_ros authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Documents that are made from the code, or that people type from, say what is true."""

from pathlib import Path
import re

from fourbar_ros.commands.main import COMMANDS
from fourbar_ros.nodes.tables import markdown_text, yaml_text
import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted([ROOT / 'README.md', *(ROOT / 'docs').glob('*.md')])


def test_parameter_tables_are_those_of_the_nodes() -> None:
    """Regenerate with `python -m fourbar_ros.nodes.tables --markdown`."""
    assert markdown_text() in (ROOT / 'docs' / 'topics.md').read_text()


def test_parameters_file_is_that_of_the_nodes() -> None:
    """Regenerate with `python -m fourbar_ros.nodes.tables > config/nodes.yaml`."""
    assert (ROOT / 'config' / 'nodes.yaml').read_text() == yaml_text()


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page: Path) -> None:
    """Follow every relative link and picture."""
    targets = re.findall(r'\]\(([^)#\s]+)\)', page.read_text())
    missing = [target for target in targets
               if not target.startswith('http') and not (page.parent / target).exists()]
    assert missing == []


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_commands_exist(page: Path) -> None:
    """Every `fourbar NAME` in a code block is a command."""
    blocks = re.findall(r'```\n(.*?)```', page.read_text(), re.DOTALL)
    names = {name for block in blocks
             for name in re.findall(r'^(?:ros2 run fourbar_ros|fourbar) ([a-z]\w*)', block,
                                    re.MULTILINE)}
    assert names <= {*COMMANDS, 'fourbar'}
