# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Run the command line as `python -m fourbar_ros`."""

import sys

from fourbar_ros.cli.main import main

if __name__ == '__main__':
    sys.exit(main())
