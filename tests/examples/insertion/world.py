"""The insertion simulator: a small MuJoCo model whose hand is pulled to a wanted pose.

The gripper holds the peg by a constraint instead of friction; the constraint is active while the fingers are closed
around the peg's upper half. A control step so takes less than 0.3 ms; peg and slot interact by contact.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kerv_cli.worlds.mujoco_world import MujocoWorld
from kerv_cli.worlds.settings import CameraSettings
from kerv_cli.worlds.spec import EnvironmentSpec
from kerv_cli.worlds.vectors import length

from .pose import GRASP, PEG_HALF, Pose, limited, misfit, mujoco, product, quaternion_of, turn_between

INSERTED = 0.03
"""Metres that the tip must be below the mouth."""
LEAD, TURN_LEAD = 0.03, 0.25
"""Largest lead of the wanted pose over the hand, metres and radians, so that a blocked hand builds up no force."""
_WORKSPACE = np.array([[-0.25, -0.25, 0.02], [0.25, 0.25, 0.35]])  # metres, of the hand
_CLOSING = 0.34  # of the opening, per control step
_HOLDS = 0.5  # opening below which the fingers touch the peg
_REACH, _REACH_ANGLE = 0.012, 0.25  # metres and radians from the grasp within which closing holds the peg
_SIDEWAYS, _ASKEW = 0.006, 0.15  # metres and radians that an inserted peg may be off
_FINGER = 0.023, 0.012  # metres: the fingers' distance from the middle when closed, and the added one when open


class InsertionWorld(MujocoWorld):
    """Task `insert-peg`: the peg is in the hand, the slot is tilted. `fetch-peg`: the peg stands on the table."""

    def __init__(
        self, spec: EnvironmentSpec, task: str, camera: CameraSettings | None = None, horizon: int = 0
    ) -> None:
        super().__init__(spec, task, camera, horizon)
        self._model: Any = None
        self._data: Any = None
        self._opening = 1.0
        self._wanted = Pose.of(np.zeros(3), np.zeros(3))
        self._placement = np.zeros(0)

    @property
    def initial_state(self) -> NDArray[np.float64]:
        """(15,) float64: position and rotation vector of slot and peg, position of the hand."""
        self.observation  # noqa: B018 - raises before the first reset
        return self._placement.copy()

    def _start(self, seed: int) -> NDArray[np.float64]:
        if self._model is None:
            self._model = mujoco.MjModel.from_xml_path(str(Path(__file__).with_name("model.xml")))
            self._data = mujoco.MjData(self._model)
        mujoco.mj_resetData(self._model, self._data)
        slot, peg, hand = place(self.task, np.random.default_rng([seed, *self.task.encode()]))
        self._placement = np.concatenate([slot.position, slot.vector, peg.position, peg.vector, hand.position])
        self._data.mocap_pos[0], self._data.mocap_quat[0] = slot.position, slot.quaternion
        self._data.qpos[:] = np.concatenate([hand.position, hand.quaternion, peg.position, peg.quaternion])
        self._wanted, held = hand, self.task == "insert-peg"
        self._opening = 0.0 if held else 1.0
        self._data.eq_active[0] = False
        if held:
            self._hold()
        mujoco.mj_forward(self._model, self._data)
        return self._state()

    def _hold(self) -> None:
        """Fixes the peg to the hand in its present pose."""
        relative = self._peg.seen_from(self._hand)
        self._model.eq_data[0, :3] = 0.0  # the weld's point, in the peg
        self._model.eq_data[0, 3:10] = np.concatenate([relative.position, relative.quaternion])
        self._data.eq_active[0] = True

    @property
    def _hand(self) -> Pose:
        return Pose(self._data.qpos[:3].copy(), self._data.qpos[3:7].copy())

    @property
    def _peg(self) -> Pose:
        return Pose(self._data.qpos[7:10].copy(), self._data.qpos[10:].copy())

    @property
    def _slot(self) -> Pose:
        return Pose(self._data.mocap_pos[0].copy(), self._data.mocap_quat[0].copy())

    def _state(self) -> NDArray[np.float64]:
        """The privileged state (19,), laid out as in the spec."""
        hand, peg, slot = self._hand, self._peg, self._slot
        felt = [hand.position, hand.vector, [self._opening]]
        return np.concatenate([*felt, peg.position, slot.position, slot.vector, peg.vector])

    def _advance(self, action: NDArray[np.float64]) -> tuple[NDArray[np.float64], bool]:
        hand = self._hand
        self._wanted = self._ahead(hand, action)
        self._data.ctrl[:] = np.concatenate([self._wanted.position, self._wanted.vector])
        self._grip(float(action[6]), hand)
        control_step = 1.0 / self.spec.actions.control_hz
        mujoco.mj_step(self._model, self._data, nstep=round(control_step / self._model.opt.timestep))
        depth, sideways, askew = misfit(self._peg, self._slot)
        return self._state(), depth >= INSERTED and sideways <= _SIDEWAYS and askew <= _ASKEW

    def _ahead(self, hand: Pose, action: NDArray[np.float64]) -> Pose:
        """The wanted pose after one more action."""
        position = hand.position + limited(self._wanted.position + action[:3] - hand.position, LEAD)
        wanted = Pose(position, product(quaternion_of(action[3:6]), self._wanted.quaternion))
        turn = quaternion_of(limited(turn_between(hand, wanted), TURN_LEAD))
        return Pose(np.clip(position, *_WORKSPACE), product(turn, hand.quaternion))

    def _grip(self, wanted: float, hand: Pose) -> None:
        """Moves the fingers towards the opening `wanted`; closing around the peg holds it, opening releases it."""
        before = self._opening
        self._opening += float(np.clip(wanted - before, -_CLOSING, _CLOSING))
        if self._opening >= _HOLDS:
            self._data.eq_active[0] = False
        elif before >= _HOLDS:
            off = hand.seen_from(self._peg.along(GRASP))
            if length(off.position) <= _REACH and off.angle <= _REACH_ANGLE:
                self._hold()

    def _drawable(self) -> tuple[Any, Any]:
        # A step leaves poses as they were before its last substep. The next step computes them anew, so drawing does
        # not change the physics.
        for name, side in (("left", 1.0), ("right", -1.0)):
            self._model.geom(name).pos[0] = side * (_FINGER[0] + _FINGER[1] * self._opening)
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        return self._model, self._data

    def close(self) -> None:
        """As `World.close`."""
        super().close()
        self._model = self._data = None


def place(task: str, random: np.random.Generator) -> tuple[Pose, Pose, Pose]:
    """Poses of slot, peg and hand at the start of an episode. The slot is always turned, too far for an unturned
    peg."""
    yaw = random.choice([-1.0, 1.0]) * random.uniform(0.35, 1.0)
    if task == "insert-peg":
        tilt = quaternion_of(np.array([*random.uniform(-0.2, 0.2, 2), 0.0]))
        turn = quaternion_of(np.array([0.0, 0.0, yaw]))
        slot = Pose(np.array([*random.uniform(-0.09, 0.09, 2), 0.08]), product(tilt, turn))
        hand = Pose.of(np.array([*random.uniform(-0.06, 0.06, 2), random.uniform(0.24, 0.28)]), np.zeros(3))
        return slot, hand.along(-GRASP), hand
    place_of_slot = np.array([random.uniform(0.05, 0.11), random.uniform(-0.08, 0.08), 0.07])
    slot = Pose.of(place_of_slot, np.array([0.0, 0.0, yaw]))
    turned = np.array([0.0, 0.0, random.uniform(-0.8, 0.8)])
    place_of_peg = np.array([random.uniform(-0.11, -0.05), random.uniform(-0.08, 0.08), PEG_HALF])
    peg = Pose.of(place_of_peg, turned)
    return slot, peg, Pose.of(np.array([*random.uniform(-0.03, 0.03, 2), 0.2]), np.zeros(3))
