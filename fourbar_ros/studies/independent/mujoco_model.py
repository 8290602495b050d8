# Copyright 2026 The fourbar_ros authors
# SPDX-License-Identifier: Apache-2.0

"""
The linkage as a MuJoCo model: a tree of four links with an equality constraint at joint 3.

In the plane (two slides and a hinge for link a), without gravity, contact or friction: b turns on
a at joint 1, c on b at joint 2, d on a at joint 4, and `equality/connect` joins the far ends of c
and d. MuJoCo's constraints are soft by design (section "Constraint model" of its documentation):
joint 3 is compliant, and `solref`, `solimp` and the step limit the accuracy of a motion. Torques
are held over each step.

Needs MuJoCo 3.4 or later; importing this module does not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any

from fourbar_ros.common.errors import FourbarError
from fourbar_ros.mechanism import Mechanism
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

INTEGRATORS = ('Euler', 'RK4')
LETTERS = 'abcd'

# Share of a link's mass that its wheel has, because MuJoCo requires a mass for every body.
WHEEL_SHARE = 1e-6

# omega = ANGLES_OF_HINGES @ (rate of hinge a, b, c, d): b turns on a, c on b, d on a.
ANGLES_OF_HINGES = np.array([
    [1.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [1.0, 1.0, 1.0, 0.0], [1.0, 0.0, 0.0, 1.0]])
HINGES_OF_ANGLES = np.linalg.inv(ANGLES_OF_HINGES)

# Stages of MuJoCo's step without effect in this model, see `Settings.lean`.
UNUSED = ('contact', 'island', 'warmstart', 'gravity', 'actuation', 'sensor', 'limit',
          'frictionloss', 'spring', 'damper')

# Tolerance of times as multiples of the step [steps].
_ROUNDING = 1e-6


class MujocoError(FourbarError):
    """An unknown setting, or a motion that MuJoCo cannot simulate."""


@dataclass(frozen=True)
class Settings:
    """
    Integrator and stiffness of the closure; MuJoCo's own defaults except for the step.

    :param integrator: `Euler` (semi-implicit) or `RK4`.
    :param timestep: [s].
    :param solref: time constant [s] and damping ratio of the spring that closes joint 3; MuJoCo
        limits the time constant to at least two steps.
    :param solimp: impedance without gap and at a wide one, the width [m], and the shape in
        between; MuJoCo limits the impedance to 0.9999.
    :param tolerance: of the constraint solver.
    :param iterations: largest number of iterations of the constraint solver.
    :param lean: disable the stages without effect in this model; the motion is the same.
    :raises MujocoError: unknown integrator, or a step that is not positive.
    """

    integrator: str = 'Euler'
    timestep: float = 1e-3
    solref: tuple[float, float] = (0.02, 1.0)
    solimp: tuple[float, float, float, float, float] = (0.9, 0.95, 0.001, 0.5, 2.0)
    tolerance: float = 1e-8
    iterations: int = 100
    lean: bool = False

    def __post_init__(self) -> None:
        """Check the settings, with clearer messages than MuJoCo's."""
        if self.integrator not in INTEGRATORS:
            raise MujocoError(
                f'unknown integrator {self.integrator!r} (known are {", ".join(INTEGRATORS)})',
                name='integrator', value=self.integrator, limit=INTEGRATORS)
        if not 0.0 < self.timestep < np.inf:
            raise MujocoError('timestep must be a positive number of seconds, '
                              f'got {self.timestep:g}', name='timestep', value=self.timestep)


def stiff(integrator: str, timestep: float) -> Settings:
    """
    Return settings with the stiffest closure that improves the accuracy.

    MuJoCo would take a time constant of two steps, but then what each step's torque excites of
    the spring shows in the rates; at four it does not, and joint 3 is open by less than 1e-11 m.
    The tolerance is below all that links of grams need: the default one lets the solver leave
    small forces out altogether.

    :param timestep: [s].
    :raises MujocoError: as :class:`Settings`.
    """
    return Settings(integrator, timestep, (4.0 * timestep, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0),
                    tolerance=1e-14)


@dataclass(frozen=True, eq=False)
class State:
    """
    A state of the linkage, or n of them, in the conventions of docs/mechanics.md.

    :param link_angles: (..., 4) continuous [rad].
    :param link_rates: (..., 4) [rad/s].
    :param flywheel_angles: (..., 4) relative to the link [rad].
    :param flywheel_speeds_absolute: (..., 4) [rad/s]; of a locked wheel its link's rate.
    :param centre_position: (..., 2) mass centre of the whole in the table frame [m].
    :param centre_velocity: (..., 2) [m/s].
    """

    link_angles: Array
    link_rates: Array
    flywheel_angles: Array
    flywheel_speeds_absolute: Array
    centre_position: Array
    centre_velocity: Array


class MujocoLinkage:
    """
    A linkage in MuJoCo, at rest with every angle 0 until a state is set.

    :param mechanism: any.
    :param settings: see :class:`Settings`.
    :param locked: (4,) wheels that turn with their links, their inertia added to it. For a wheel
        whose angle psi relative to its link is prescribed: `apply` the torque
        `If d2(psi)/dt2`, which its motor adds to what turns the wheel with the link.
    :raises ModuleNotFoundError: MuJoCo is not installed.
    :ivar model: the mujoco.MjModel.
    :ivar data: the mujoco.MjData.
    """

    def __init__(self, mechanism: Mechanism, settings: Settings = Settings(),  # noqa: B008
                 locked: Sequence[bool] = (False, False, False, False)) -> None:
        import mujoco  # type: ignore[import-untyped]

        self._mujoco: Any = mujoco
        self._locked = np.array(locked, dtype=bool)
        self.timestep = settings.timestep
        self.model: Any = mujoco.MjModel.from_xml_string(model_xml(mechanism, settings, locked))
        self.data: Any = mujoco.MjData(self.model)
        self._slides = self._addresses('slide_x', 'slide_y')
        self._hinges = self._addresses(*(f'hinge_{letter}' for letter in LETTERS))
        self._wheels = self._addresses(
            *(f'wheel_{letter}' for letter, fixed in zip(LETTERS, locked) if not fixed))

    def set_state(self, state: State) -> None:
        """
        Set a state at time 0, without torque.

        :param state: a single state. Its angles should close the loop, otherwise MuJoCo pulls it
            closed. Its values for locked wheels are not used.
        """
        mujoco, model, data = self._mujoco, self.model, self.data
        free = ~self._locked
        mujoco.mj_resetData(model, data)
        data.qpos[self._hinges] = HINGES_OF_ANGLES @ state.link_angles
        data.qvel[self._hinges] = HINGES_OF_ANGLES @ state.link_rates
        data.qpos[self._wheels] = state.flywheel_angles[free]
        data.qvel[self._wheels] = (state.flywheel_speeds_absolute - state.link_rates)[free]
        # The slides carry joint 1, whose position follows from that of the mass centre.
        position, velocity = self._centre()
        data.qpos[self._slides] = state.centre_position - position
        data.qvel[self._slides] = state.centre_velocity - velocity

    def state(self) -> State:
        """Return the current state."""
        data = self.data
        rates = ANGLES_OF_HINGES @ data.qvel[self._hinges]
        wheel_angles = np.zeros(4)
        wheel_angles[~self._locked] = data.qpos[self._wheels]
        wheel_speeds = rates.copy()
        wheel_speeds[~self._locked] += data.qvel[self._wheels]
        return State(ANGLES_OF_HINGES @ data.qpos[self._hinges], rates, wheel_angles,
                     wheel_speeds, *self._centre())

    def apply(self, torques: Array) -> None:
        """
        Set the motor torques until the next call.

        :param torques: (4,) on the wheels; the opposite acts on the links [N m].
        """
        # A hinge drives the whole subtree.
        self.data.qfrc_applied[self._hinges] = -ANGLES_OF_HINGES.T @ (torques * self._locked)
        self.data.qfrc_applied[self._wheels] = torques[~self._locked]

    def advance(self, steps: int = 1) -> None:
        """Advance by a number of steps under constant torques."""
        self._mujoco.mj_step(self.model, self.data, nstep=steps)

    def gap(self) -> float:
        """Return the gap of joint 3 [m]."""
        self._mujoco.mj_kinematics(self.model, self.data)
        ends = self.data.site_xpos
        return float(np.linalg.norm(ends[1] - ends[0]))

    def move(self, state: State, times: Array, torques_at: Callable[[float], Array],
             sampled: float = 0.0) -> State:
        """
        Simulate a motion from a state.

        :param state: at times[0].
        :param times: (n,) increasing, whole multiples of the step apart [s].
        :param torques_at: time [s] to (4,) torques [N m], as in :meth:`apply`.
        :param sampled: time in each step at which the held torques are sampled, in steps: 0 at its
            start, 0.5 in its middle. A smooth torque sampled at the start is late by half a step
            on average.
        :returns: (n, ...) the state at every time.
        :raises MujocoError: times that are not whole multiples of the step apart, or a motion that
            diverged.
        """
        counts = np.diff(times) / self.timestep
        whole = np.rint(counts).astype(int)
        if (np.abs(counts - whole) > _ROUNDING).any() or (whole < 1).any():
            raise MujocoError(f'times must be whole multiples of the step of {self.timestep:g} s '
                              'apart, and increasing', name='times', limit=self.timestep)
        self.set_state(state)
        states = [self.state()]
        for begin, count in zip(times, whole):
            for i in range(count):
                self.apply(torques_at(begin + (i + sampled) * self.timestep))
                self.advance()
            states.append(self.state())
        # MuJoCo restarts at time 0 when a state diverges.
        if abs(self.data.time - (times[-1] - times[0])) > 0.5 * self.timestep:
            raise MujocoError(f'the motion diverged: the step of {self.timestep:g} s is too long',
                              value=self.timestep)
        return State(*(np.array([getattr(state, item.name) for state in states])
                       for item in fields(State)))

    def _centre(self) -> tuple[Array, Array]:
        """Return position and velocity (2,) of the mass centre of the whole."""
        mujoco, model, data = self._mujoco, self.model, self.data
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        return data.subtree_com[0, :2].copy(), data.subtree_linvel[0, :2].copy()

    def _addresses(self, *names: str) -> list[int]:
        # One coordinate and one speed per joint: both are numbered alike.
        return [int(self.model.joint(name).qposadr[0]) for name in names]


def model_xml(mechanism: Mechanism, settings: Settings, locked: Sequence[bool]) -> str:
    """Write the model in MuJoCo's own format, parameters as in :class:`MujocoLinkage`."""
    def link(i: int, at: float, joints: str, *children: str) -> str:
        letter, inside = LETTERS[i], '\n'.join(children)
        x, y = map(float, mechanism.com_positions[i])
        mass = float(mechanism.link_masses[i])
        inertia = float(mechanism.link_inertias[i])
        axial = float(mechanism.flywheel_inertias[i])
        wheel = ''
        if locked[i]:
            inertia += axial
        else:
            share = WHEEL_SHARE * mass
            mass -= share
            wheel = f"""
              <body name="wheel_{letter}" pos="{x!r} {y!r} 0">
                <joint name="wheel_{letter}" axis="0 0 1"/>
                {inertial(0.0, 0.0, share, axial)}
              </body>"""
        return f"""
            <body name="link_{letter}" pos="{at!r} 0 0">
              {joints}
              <joint name="hinge_{letter}" axis="0 0 1"/>
              {inertial(x, y, mass, inertia)}{wheel}{inside}
            </body>"""

    def inertial(x: float, y: float, mass: float, inertia: float) -> str:
        # In the plane only the last of the three matters; those of a sphere are equal.
        return (f'<inertial pos="{x!r} {y!r} 0" mass="{mass!r}" '
                f'diaginertia="{inertia!r} {inertia!r} {inertia!r}"/>')

    def far_end(i: int) -> str:
        return f'<site name="end_{LETTERS[i]}" pos="{float(mechanism.link_lengths[i])!r} 0 0"/>'

    slides = """<joint name="slide_x" type="slide" axis="1 0 0"/>
              <joint name="slide_y" type="slide" axis="0 1 0"/>"""
    l_a, l_b, _, _ = map(float, mechanism.link_lengths)
    tree = link(0, 0.0, slides, link(1, 0.0, '', link(2, l_b, '', far_end(2))),
                link(3, l_a, '', far_end(3)))
    return f"""
        <mujoco model="fourbar">
          <option integrator="{settings.integrator}" timestep="{settings.timestep!r}"
              gravity="0 0 0" tolerance="{settings.tolerance!r}"
              iterations="{settings.iterations}">
            <flag {' '.join(f'{stage}="disable"' for stage in UNUSED if settings.lean)}/>
          </option>
          <worldbody>{tree}
          </worldbody>
          <equality>
            <connect site1="end_c" site2="end_d" solref="{_list(settings.solref)}"
                solimp="{_list(settings.solimp)}"/>
          </equality>
        </mujoco>"""


def _list(values: Sequence[float]) -> str:
    return ' '.join(repr(float(value)) for value in values)
