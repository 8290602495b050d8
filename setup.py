# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""Install the package, for pip and for colcon alike; package.xml lists the same for rosdep."""

from glob import glob
import os
import re

from setuptools import find_packages, setup

PACKAGE = 'fourbar_ros'

with open(os.path.join(PACKAGE, '__init__.py'), encoding='utf-8') as stream:
    VERSION = re.search(r"^__version__ = '(.+)'$", stream.read(), re.MULTILINE).group(1)

EXTRAS = {
    'hardware': ['cantools>=39', 'msgpack>=1', 'pyserial>=3.4', 'python-can>=4.3'],
    'analysis': [
        'cma>=3.3',
        'dask[distributed]>=2024.1',
        'loky>=3.4',
        'matplotlib>=3.7',
        'pyarrow>=14',
        'rosbags>=0.11',
        'tqdm',
    ],
    'dev': [
        'colcon-core>=0.15',
        'colcon-library-path',
        'colcon-output',
        'colcon-package-selection',
        'colcon-python-setup-py',
        'colcon-recursive-crawl',
        'colcon-ros>=0.5',
        'colcon-test-result',
        'hypothesis',
        'mujoco>=3.7',
        'mypy',
        'pytest',
        'pytest-xdist',
        'ruff',
        'sympy>=1.13',
        'types-PyYAML',
    ],
    # colcon runs the tests with pytest only where this extra names it.
    'test': ['pytest'],
}
EXTRAS['all'] = sorted({requirement for extra in EXTRAS.values() for requirement in extra})


def files(folder):
    """Return what to install into the share folder from one folder: its files, if any."""
    return f'share/{PACKAGE}/{folder}', sorted(filter(os.path.isfile, glob(f'{folder}/*')))


setup(
    name=PACKAGE,
    version=VERSION,
    description='Simulate, estimate, control and drive a free-floating four-bar linkage '
                'with flywheels',
    maintainer='fourbar_ros maintainers',
    maintainer_email='maintainers@fourbar-ros.invalid',
    license='Apache-2.0',
    python_requires='>=3.10',
    packages=find_packages(include=[PACKAGE, f'{PACKAGE}.*']),
    package_data={PACKAGE: ['analysis/report.html']},
    zip_safe=False,
    install_requires=[
        'PyYAML',
        'argcomplete',
        'filterpy>=2',
        'numba>=0.59',
        'numpy>=1.26',
        'ros-jazzy-common-interfaces',
        'ros-jazzy-rclpy>=7.1.4',
        'ros-jazzy-rmw-fastrtps-cpp',
        'scipy>=1.11',
    ],
    extras_require=EXTRAS,
    entry_points={
        'console_scripts': [f'fourbar = {PACKAGE}.cli.main:main'],
        # What python-can calls a bus by: `interface: fourbar_udp`.
        'can.interface': [f'fourbar_udp = {PACKAGE}.hardware.udp_bus:UdpBus'],
    },
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{PACKAGE}']),
        (f'share/{PACKAGE}', ['package.xml']),
        files('config'),
        files('config/reference'),
        files('launch'),
        # Where `ros2 run` looks. Each is a link to the one stub _run, named for what it runs.
        (f'lib/{PACKAGE}', sorted(glob('scripts/[!_]*'))),
    ],
)
