# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The command line as a whole: names, help, exit codes and error messages."""

import os
import subprocess
import sys
from types import SimpleNamespace

from fourbar_ros import __version__
from fourbar_ros.cli import main as command_line
from fourbar_ros.cli.main import COMMANDS, main, NODES
from fourbar_ros.common.errors import FourbarError
import pytest

# Commands with quantities as arguments or results, and a unit that --help must name.
UNITS = {'setpoint': '[rad]', 'simulate': '[s]'}
HEAVY = ('numpy', 'numba', 'rclpy', 'matplotlib', 'rosbags', 'scipy')


@pytest.fixture
def stub(monkeypatch):
    """Return a function that replaces a command by a function."""
    def replace(run):
        module = SimpleNamespace(add_arguments=lambda parser: None, run=run)
        monkeypatch.setattr(command_line, '_module', lambda command: module)
    return replace


def test_missing_command_prints_the_help_and_fails(capsys):
    assert main([]) == 2
    out = capsys.readouterr().out
    for name, text in COMMANDS.items():
        assert name in out
        assert text in ' '.join(out.split())


def test_version(capsys):
    with pytest.raises(SystemExit) as done:
        main(['--version'])
    assert done.value.code == 0
    assert capsys.readouterr().out == f'fourbar_ros {__version__}\n'


def test_unknown_command_is_refused_with_the_known_ones(capsys):
    with pytest.raises(SystemExit) as done:
        main(['dance'])
    assert done.value.code == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert 'dance' in last
    assert 'setpoint' in last


@pytest.mark.parametrize('name', [name for name in COMMANDS if name not in NODES])
def test_every_command_has_a_help_text(name, capsys):
    with pytest.raises(SystemExit) as done:
        main([name, '--help'])
    assert done.value.code == 0
    out = capsys.readouterr().out
    assert out.startswith(f'usage: fourbar {name}')
    assert UNITS.get(name, '') in out


def test_exit_code_of_a_command_is_returned(stub):
    stub(lambda args: {'stop': 7}[args.command])
    assert main(['stop']) == 7


def test_error_is_one_line_and_code_2(stub, capsys):
    def fail(args):
        raise FourbarError('the dog ate it')
    stub(fail)
    assert main(['status']) == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ('', 'fourbar status: the dog ate it\n')


def test_interrupt_is_one_line_and_code_130(stub, capsys):
    def interrupt(args):
        raise KeyboardInterrupt
    stub(interrupt)
    assert main(['demo']) == 130
    assert capsys.readouterr().err == 'fourbar demo: interrupted\n'


def test_end_of_the_reader_of_stdout_prints_nothing():
    code = ('from fourbar_ros.cli import main; from types import SimpleNamespace\n'
            'def run(args):\n'
            '    for _ in range(100000): print("a line")\n'
            'main._module = lambda command: '
            'SimpleNamespace(add_arguments=lambda parser: None, run=run)\n'
            'import sys; sys.exit(main.main(["status"]))')
    with subprocess.Popen([sys.executable, '-c', code], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True) as process:
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ''
        assert process.wait(60) == 1


@pytest.mark.parametrize('arguments', [['--help'], ['--version'], ['demo', '--help'],
                                       ['setpoint', '--help']])
def test_help_imports_no_heavy_library(arguments):
    code = ('import sys; from fourbar_ros.cli.main import main\n'
            'try: main(sys.argv[1:])\n'
            'except SystemExit: pass\n'
            f'sys.stderr.write(str([name for name in {HEAVY} if name in sys.modules]))')
    done = subprocess.run([sys.executable, '-c', code, *arguments], capture_output=True,
                          text=True, timeout=60)
    assert done.stderr == '[]'


def test_completion_lists_commands_and_their_options():
    def completed(line):
        read, write = os.pipe()
        # argcomplete answers on file descriptor 8.
        code = ('import os, sys; os.dup2(int(sys.argv.pop()), 8)\n'
                'from fourbar_ros.cli.main import main; main([])')
        variables = {'_ARGCOMPLETE': '1', 'COMP_LINE': line, 'COMP_POINT': str(len(line)),
                     '_ARGCOMPLETE_IFS': '\n', '_ARGCOMPLETE_COMP_WORDBREAKS': ' '}
        subprocess.run([sys.executable, '-c', code, str(write)], pass_fds=[write],
                       env={**os.environ, **variables}, timeout=60, capture_output=True)
        os.close(write)
        with os.fdopen(read) as answer:
            return answer.read().split()
    assert {'setpoint', 'simulate', 'status', 'stop'} <= set(completed('fourbar s'))
    assert '--output' in completed('fourbar demo --')
