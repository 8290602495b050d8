# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The base class of all nodes: parameters from declarations, and the main function of a node."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isfinite
from typing import Any, TypeVar

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.settings import Setting, Settings, settings_of
from fourbar_ros.kernels.compiler import announced
from fourbar_ros.ros.environment import RosError, set_realtime_priority
from fourbar_ros.ros.runtime import flush, one_line, Runtime
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import (
    InvalidNamespaceException,
    InvalidNodeNameException,
    InvalidTopicNameException,
    ParameterException,
)
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.utilities import remove_ros_args

# Parameters of every node, beside those of its settings.
COMMON_PARAMETERS = (
    Setting('realtime_priority', 0, '', 'real-time priority of the process (SCHED_FIFO), 0 for '
            'none', low=0, high=99),
)

_Settings = TypeVar('_Settings', bound=Settings)


class BaseNode(Node):
    """
    A node whose parameters are declared by settings.

    :param name: default name of the node.
    :param declarations: of its parameters; `COMMON_PARAMETERS` are added.
    :ivar runtime: the ROS of this process.
    :ivar logger: of this node.
    :ivar values: value of each parameter by name, up to date.
    :raises SettingError: a parameter override is refused.
    """

    def __init__(self, runtime: Runtime, name: str, declarations: Sequence[Setting]
                 ) -> None:
        super().__init__(name)
        self.runtime = runtime
        self.logger = Node.get_logger(self)
        self.values: dict[str, Any] = {}
        self._declarations = {row.name: row for row in (*declarations, *COMMON_PARAMETERS)}
        for row in self._declarations.values():
            # Integers are valid overrides of double parameters: the type must not be fixed.
            parameter = self.declare_parameter(row.name, row.default, ParameterDescriptor(
                description=f'{row.meaning} [{row.unit}]' if row.unit else row.meaning,
                additional_constraints=row.allowed, read_only=not row.live, dynamic_typing=True))
            self.values[row.name] = row.check(parameter.value)
        self.add_on_set_parameters_callback(self._on_set_parameters)

    @property
    def simulated_time(self) -> bool:
        """Whether stamps are simulated time."""
        return bool(self.get_parameter('use_sim_time').value)

    def parameters_changed(self, values: dict[str, Any]) -> None:
        """
        Apply new values of parameters; `self.values` still holds the present ones.

        :raises FourbarError: the values are refused and nothing changed.
        """

    def request_priority(self) -> None:
        """Request the real-time priority of the parameters; a refusal is only logged."""
        if priority := self.values['realtime_priority']:
            try:
                set_realtime_priority(priority)
            except PermissionError:
                self.logger.warning(
                    f'realtime_priority {priority} is not permitted: raise the limit rtprio of '
                    'this user (docs/install.md); the node runs without it')

    def run_once(self) -> None:
        """Run the next callback."""
        self.runtime.spin_once()

    def close(self) -> None:
        """Publish the last messages and release devices, before the node is destroyed."""

    def describe_parameter(self, name: str) -> Any:
        """
        Return the descriptor of a parameter, with its range.

        The stored descriptor has no range: rclpy would check it before the callback of this class
        and refuse values with its own message, without unit and meaning.
        """
        stored = super().describe_parameter(name)
        row = self._declarations.get(name)
        if row is None or row.limits is None or not all(map(isfinite, row.limits)):
            return stored
        # A copy in the wire format: messages have no copy constructor.
        descriptor = ParameterDescriptor(**{
            field: getattr(stored, field) for field in stored.get_fields_and_field_types()})
        low, high = row.limits
        if row.kind is float:
            descriptor.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))]
        else:
            descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
        return descriptor

    def _on_set_parameters(self, parameters: Iterable[Parameter]) -> Any:
        values = dict(self.values)
        try:
            for parameter in parameters:
                name = parameter.name
                if name in self._declarations:
                    values[name] = self._declarations[name].check(parameter.value)
            if values != self.values:
                self.parameters_changed(values)
        except FourbarError as error:
            return SetParametersResult(successful=False, reason=str(error))
        self.values.update(values)
        return SetParametersResult(successful=True)


def settings_from(kind: type[_Settings], values: Mapping[str, Any], prefix: str = '') -> _Settings:
    """
    Return an object of settings from the values of parameters.

    :param prefix: of the names of the parameters, as `initial.`.
    """
    return kind(**{row.name: values[prefix + row.name] for row in settings_of(kind)})


def run_node(make_node: Callable[[Runtime], BaseNode], name: str, description: str,
             argv: Sequence[str]) -> int:
    """
    Run one node until a signal arrives.

    :param argv: arguments after the name of the executable.
    :returns: exit code.
    :raises RosError: the arguments are refused, or ROS is not usable.
    """
    argv = list(argv)
    parser = argparse.ArgumentParser(
        prog=f'fourbar {name}', description=description, usage=f'fourbar {name} [--ros-args ...]',
        epilog='Parameters (-p name:=value, --params-file FILE), remapping (-r) and namespace '
               '(-r __ns:=/lab) follow --ros-args. docs/topics.md lists topics and parameters, '
               'with units.')
    try:
        own_args = remove_ros_args(args=[name, *argv])[1:]
    except Exception as error:  # noqa: BLE001 - the errors of rcl have no common class
        raise RosError(one_line(error)) from None
    parser.parse_args(own_args)
    runtime = Runtime(argv)
    node: BaseNode | None = None
    try:
        # The constructor of a node compiles every kernel, so that none is compiled at run time.
        with announced():
            node = make_node(runtime)
        runtime.executor.add_node(node)
        node.request_priority()
        runtime.spin(node.run_once)
    except (InvalidNamespaceException, InvalidNodeNameException, InvalidTopicNameException,
            ParameterException) as error:
        raise RosError(one_line(error)) from None
    finally:
        if node is not None:
            node.close()
            flush(node.publishers)
        runtime.shut_down(node)
    return 0
