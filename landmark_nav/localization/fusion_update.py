"""Which measurements to believe, and the iterated update with those."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from scipy.special import chdtri

from landmark_nav.localization.fusion_state import (
    bearing_model,
    correct,
    FilterState,
    MeasurementModel,
    pose_model,
)
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate, Refusal

__all__ = ['BearingFrame', 'FusionUpdate', 'update_bearings', 'update_pose']

IndexArray = npt.NDArray[np.intp]

_MAX_ITERATIONS = 4
_NO_IDS = np.empty(0, dtype=np.int64)
_NO_INNOVATIONS = np.empty(0)


@dataclass(frozen=True, eq=False)
class FusionUpdate:
    """
    What became of one measurement.

    Parameters
    ----------
    stamp_ns : int
        Its time.
    accepted_ids : ndarray of int, shape (m,)
        Landmarks whose bearings were used; empty for a pose.
    innovation_rad : ndarray, shape (m,)
        Their measured minus predicted bearings; for a pose its three differences.
    nis : float
        Normalized innovation squared of what was used.
    degrees : int
        Its degrees of freedom; 0 if nothing was used.
    rejected : dict of int to Refusal
        Why, by landmark id.
    refusal : Refusal or None
        Why the whole measurement was not used.

    """

    stamp_ns: int
    accepted_ids: npt.NDArray[np.int64] = field(default_factory=lambda: _NO_IDS)
    innovation_rad: FloatArray = field(default_factory=lambda: _NO_INNOVATIONS)
    nis: float = 0.0
    degrees: int = 0
    rejected: dict[int, Refusal] = field(default_factory=dict)
    refusal: Refusal | None = None


@dataclass(frozen=True, eq=False)
class BearingFrame:
    """
    The bearings of one picture, ready for the filter.

    `columns` (m,) are places of the landmarks in the map, `noise` (m, m) the bearings' joint
    covariance, `unusable` what was sorted out before.
    """

    columns: IndexArray
    bearing_rad: FloatArray
    noise: FloatArray
    unusable: dict[int, Refusal]


def update_bearings(
    prior: FilterState,
    frame: BearingFrame,
    landmark_map: LandmarkMap,
    lever: FloatArray,
    probability: float,
    least: int = 1,
) -> tuple[FilterState, FusionUpdate]:
    """
    Use the bearings of a frame that agree with the prior and with each other.

    Parameters
    ----------
    prior : FilterState
        State at the frame's time.
    frame : BearingFrame
        What was seen.
    landmark_map : LandmarkMap
        Where the landmarks are.
    lever : ndarray, shape (2,)
        Pan axis in the base frame, metres.
    probability : float
        Chi-square level of the gates.
    least : int
        Fewer agreeing bearings are not used.

    """

    def model_at(state: FilterState, chosen: IndexArray) -> MeasurementModel:
        return bearing_model(
            state,
            frame.columns[chosen],
            frame.bearing_rad[chosen],
            frame.noise[np.ix_(chosen, chosen)],
            landmark_map.positions[:, :2],
            landmark_map.joint_covariance_xy,
            lever,
        )

    everything = np.arange(len(frame.columns))
    model = model_at(prior, everything)
    chosen, rejected = _agreeing(model, landmark_map.ids[frame.columns], probability)
    rejected.update(frame.unusable)
    if len(chosen) < max(least, (len(everything) + 1) // 2):
        refusal = Refusal(
            'bearings do not fit the expected pose',
            f'{len(chosen)} of {len(everything)} agree, '
            f'largest innovation {np.degrees(np.abs(model.residual).max()):.2f} deg',
        )
        return prior, FusionUpdate(prior.stamp_ns, rejected=rejected, refusal=refusal)
    if len(chosen) < len(everything):
        model = model_at(prior, chosen)
    accepted = FusionUpdate(
        prior.stamp_ns,
        landmark_map.ids[frame.columns[chosen]],
        model.residual,
        _nis(model),
        len(chosen),
        rejected,
    )
    return _iterated(prior, model, lambda state: model_at(state, chosen)), accepted


def update_pose(
    prior: FilterState, measured: PoseEstimate, probability: float
) -> tuple[FilterState, FusionUpdate]:
    """Use a triangulated pose of the base, if it agrees with the prior."""
    model = pose_model(prior, measured)
    nis = _nis(model)
    limit = float(chdtri(3, 1.0 - probability))
    if nis > limit:
        refusal = Refusal('pose does not fit the expected one', f'NIS {nis:.1f} over {limit:.1f}')
        return prior, FusionUpdate(prior.stamp_ns, refusal=refusal)
    update = FusionUpdate(prior.stamp_ns, innovation_rad=model.residual, nis=nis, degrees=3)
    return correct(prior, model, prior), update


def _nis(model: MeasurementModel) -> float:
    return float(model.residual @ np.linalg.solve(model.innovation, model.residual))


def _agreeing(
    model: MeasurementModel, ids: npt.NDArray[np.int64], probability: float
) -> tuple[IndexArray, dict[int, Refusal]]:
    """Places of the bearings that pass their own gate and then the joint one."""
    square = model.residual**2 / np.diag(model.innovation)
    alone = square <= float(chdtri(1, 1.0 - probability))
    rejected = {
        int(ids[k]): Refusal(
            'outside its gate',
            f'{np.degrees(model.residual[k]):.2f} deg, {np.sqrt(square[k]):.1f} sigma',
        )
        for k in np.flatnonzero(~alone)
    }
    chosen = np.flatnonzero(alone)
    while len(chosen):
        inverse = np.linalg.inv(model.innovation[np.ix_(chosen, chosen)])
        weighted = inverse @ model.residual[chosen]
        nis = float(model.residual[chosen] @ weighted)
        if nis <= float(chdtri(len(chosen), 1.0 - probability)):
            break
        # What the NIS would fall by without each: its square given all the others.
        worst = int(np.argmax(weighted**2 / np.diag(inverse)))
        rejected[int(ids[chosen[worst]])] = Refusal(
            'disagrees with the others', f'joint NIS {nis:.1f} of {len(chosen)} bearings'
        )
        chosen = np.delete(chosen, worst)
    return chosen, rejected


def _iterated(
    prior: FilterState,
    model: MeasurementModel,
    model_at: Callable[[FilterState], MeasurementModel],
) -> FilterState:
    """Repeat the update about its own result until it stays, at most to 0.1 mm and 0.1 mrad."""
    state = correct(prior, model, prior)
    moved = state.mean - prior.mean
    # A step small beside the landmarks' distance is as good as linear.
    for _ in range(_MAX_ITERATIONS - 1):
        if np.abs(moved[:3]).max() < 1e-2:
            break
        improved = correct(state, model_at(state), prior)
        moved = improved.mean - state.mean
        state = improved
    return state
