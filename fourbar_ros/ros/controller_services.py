# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""What a controller is told by service: to drive or not, to hold, to stop all rates."""

from fourbar_ros.control import SetpointError
from std_srvs.srv import SetBool, Trigger


class ControllerServices:
    """
    Let people enable the controller, and let it hold or damp.

    :param announce: called after every change.
    """

    def __init__(self, node, controller, guard, announce):
        self._controller = controller
        self._announce = announce
        node.create_service(SetBool, 'enable', guard(self._on_enable))
        node.create_service(Trigger, 'hold', guard(self._on_hold))
        node.create_service(Trigger, 'damp', guard(self._on_damp))

    def _on_enable(self, request, response):
        self._controller.enable(request.data)
        response.success = True
        response.message = ('enabled' if request.data else 'not enabled: the wheels get no torque')
        self._announce()
        return response

    def _on_hold(self, _request, response):
        return self._try(response, self._controller.hold, 'holds')

    def _on_damp(self, _request, response):
        return self._try(response, self._controller.damp, 'stops all rates')

    def _try(self, response, act, done):
        try:
            act()
        except SetpointError as error:
            response.success, response.message = False, str(error)
        else:
            response.success, response.message = True, done
        self._announce()
        return response
