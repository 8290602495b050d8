# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""A request to a service, repeated until it is answered."""

from math import inf
import time

from fourbar_ros.common import names

# Who waits for so long asks again [s].
ASK_AGAIN = 1.0

# Services which, asked twice, leave the device as they do asked once, whatever others ask in
# between. `sim/step` is none, and to arm, to enable or to release a stop is none, either: somebody
# else may have disarmed or stopped meanwhile.
REPEATABLE = frozenset(
    {names.DAMP, names.EMERGENCY_STOP, names.ESTIMATE_RESET, names.HOLD,
     names.SIM_PAUSE, names.SIM_RESET})

# Likewise, if they are asked for no.
REPEATABLE_NO = frozenset({names.ARM, names.ENABLE})

# What is asked once is asked so much later, when the server knows who asks [s].
ACQUAINTED_AFTER = 0.2


class ServiceCall:
    """
    A request to a service, made by the first look whether it is answered.

    A server drops an answer to a client that it has not discovered yet, and the client finds the
    server before that (ros2/rmw_fastrtps, issue 842): what was asked first may have been done
    without an answer.

    :param client: of a service that is ready.
    :param service: its name as in REPEATABLE; any other is asked once.
    """

    def __init__(self, client, service, request):
        self._client = client
        self._request = request
        again = service in REPEATABLE or service in REPEATABLE_NO and not request.data
        self._interval = ASK_AGAIN if again else inf
        self._due = time.monotonic() + (0.0 if again else ACQUAINTED_AFTER)
        self._asked = []

    def answered(self):
        """Tell whether an answer came, and ask again if none did for long."""
        now = time.monotonic()
        if self._answer() is None and now >= self._due:
            self._asked.append(self._client.call_async(self._request))
            self._due = now + self._interval
        return self._answer() is not None

    @property
    def response(self):
        """The response, once there is one."""
        return self._answer().result()

    def _answer(self):
        # To whichever: an answer may be late and not lost.
        return next((future for future in self._asked if future.done()), None)
