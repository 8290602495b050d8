# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What really is, and where the energy went: the topics that only a simulated table has."""

from dataclasses import fields
from math import cos, sin

from fourbar_ros.mechanism import FLYWHEEL_NAMES, LINK_NAMES
from fourbar_ros.plant.energy_budget import EnergyBudget
from fourbar_ros.ros.messages import JointStatePublisher, RELIABLE, TABLE_FRAME
from nav_msgs.msg import Odometry

# Energies, then angular momenta, then the number of contacts with the edge.
LEDGER_NAMES = tuple(
    item.name if item.name == 'contacts' else
    f'{item.name}_n_m_s' if item.name.endswith('_spin') else f'{item.name}_j'
    for item in fields(EnergyBudget))

# How often the accounts are drawn up [Hz of the stamps]: slowly, they are sums.
LEDGER_RATE = 10.0


class GroundTruth:
    """
    Publish the state without its sensors, and the accounts of energy and momentum.

    :param period_ns: how often it will be asked to [ns].
    """

    def __init__(self, node, device, period_ns):
        self._device = device
        self._links = JointStatePublisher(node, 'sim/link_states', LINK_NAMES, frame=TABLE_FRAME)
        self._wheels = JointStatePublisher(
            node, 'sim/flywheel_states', FLYWHEEL_NAMES, ('position', 'velocity', 'effort'))
        self._ledger = JointStatePublisher(node, 'sim/ledger', LEDGER_NAMES, ('position',))
        self._ticks_per_ledger = max(1, round(1e9 / period_ns / LEDGER_RATE))
        self._ticks = 0
        self._odometry = node.create_publisher(Odometry, 'sim/odometry', RELIABLE)
        self._message = Odometry()
        self._message.header.frame_id = TABLE_FRAME
        self._message.child_frame_id = LINK_NAMES[0]

    def publish(self, stamp_ns, truth):
        """Publish what belongs to a tick."""
        self._links.publish(stamp_ns, truth.link_angles, truth.link_rates)
        self._wheels.publish(stamp_ns, truth.wheel_angles, truth.wheel_speeds, truth.efforts)
        self._publish_odometry(stamp_ns, truth)
        if self._ticks % self._ticks_per_ledger == 0:
            ledger = self._device.ledger()
            self._ledger.publish(
                stamp_ns, [getattr(ledger, item.name) for item in fields(ledger)])
        self._ticks += 1

    def _publish_odometry(self, stamp_ns, truth):
        """Tell where the frame of link a is, and its twist, seen from itself (REP 105)."""
        message, angle = self._message, truth.link_angles[0]
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        pose, twist = message.pose.pose, message.twist.twist
        pose.position.x, pose.position.y = truth.base_position.tolist()
        pose.orientation.z, pose.orientation.w = sin(0.5 * angle), cos(0.5 * angle)
        x, y = truth.base_velocity.tolist()
        twist.linear.x = cos(angle) * x + sin(angle) * y
        twist.linear.y = cos(angle) * y - sin(angle) * x
        twist.angular.z = float(truth.link_rates[0])
        self._odometry.publish(message)
