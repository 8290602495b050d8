# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""The services that only a simulated table has."""

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.common.monotonic_clock import monotonic_ns
from std_srvs.srv import SetBool, Trigger


class SimServices:
    """
    Let people stop simulated time, go on tick by tick, and start over.

    :param plant: node that can `advance`, `step` and `reset`.
    :param lockstep: tells who is late, None without a lock-step.
    """

    def __init__(self, plant, pace, guard, lockstep):
        self._plant = plant
        self._pace = pace
        self._lockstep = lockstep
        plant.create_service(SetBool, 'sim/pause', guard(self._on_pause))
        plant.create_service(Trigger, 'sim/step', guard(self._on_step))
        plant.create_service(Trigger, 'sim/reset', guard(self._on_reset))

    def _on_pause(self, request, response):
        if request.data:
            self._pace.pause(monotonic_ns())
        else:
            self._pace.resume(monotonic_ns())
        response.success = True
        response.message = (
            f'{"paused" if request.data else "running"} at {seconds(self._plant.now_ns())}')
        self._plant.advance()
        return response

    def _on_step(self, _request, response):
        # Who was reported is not waited for any longer: the way out for whoever is at the desk.
        if self._pace.paused and self._lockstep is not None and self._lockstep.awaited():
            self._pace.give_up()
        try:
            response.message = f'tick at {seconds(self._plant.step())}'
            response.success = True
        except FourbarError as error:
            response.success, response.message = False, f'refused: {error}'
        return response

    def _on_reset(self, _request, response):
        try:
            self._plant.reset()
            response.success = True
            response.message = f'reset and disarmed at {seconds(self._plant.now_ns())}'
        except FourbarError as error:
            response.success, response.message = False, f'refused: {error}'
        return response


def seconds(time_ns):
    """Write a time [ns] in seconds, without rounding it."""
    return f'{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d} s'
