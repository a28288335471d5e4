"""
The Schmidt-Kalman state, and how it moves on, as pure functions.

What the map may be off by is considered (Schmidt, Application of State-Space Methods to Navigation
Problems, 1966): its covariance and its correlations with the pose are carried along. So repeated
detections never make the pose more certain than the map allows.

Where nothing is in doubt, what each landmark is off by itself is also estimated, as it shows when
the robot moves on (`measurement.refined`; Brink, Partial-Update Schmidt-Kalman Filter, 2017), and
forgotten over some metres (`map_errors`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.localization.fusion.map_errors import MapErrors
from landmark_nav.localization.fusion.noise import LEARNED, NoiseScales, SLIP
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.odometry.noise import (
    blind_variances,
    jitter_variances,
    Motion,
    OdometryNoiseConfig,
    sensed_variances,
)
from landmark_nav.types import FloatArray, LandmarkMap, PoseEstimate

__all__ = [
    'BORESIGHT',
    'DELAY',
    'HEADING',
    'LENS',
    'POSE',
    'STATES',
    'TURN_LOSS',
    'FilterState',
    'initial_state',
    'looking_again',
    'measured',
    'moved_to',
    'propagate',
    'unrefined',
    'widened',
    'with_late_joints',
    'with_map',
]

# x, y, heading; of the odometry: scale of the way, drift per metre, scale of turns, side slip; of
# the camera: boresight, delay of the joint stamps, error of the principal point over the focal
# length; way lost in turns.
STATES = 11
HEADING, BORESIGHT, DELAY, LENS, TURN_LOSS = 2, 7, 8, 9, 10
_SCALE, _DRIFT, _TURN_SCALE, _SLIP = 3, 4, 5, 6
POSE = [0, 1, HEADING]
_BIASES = slice(_SCALE, _SLIP)


@dataclass(frozen=True, eq=False)
class FilterState:
    """
    What the filter knows at one time; never changed in place.

    Parameters
    ----------
    stamp_ns : int
        Time.
    mean : ndarray, shape (STATES,)
        Pose of the base in map and the systematic errors.
    covariance : ndarray, shape (STATES, STATES)
        Of `mean`.
    cross : ndarray, shape (STATES, F + 3n)
        Covariance of `mean` with the errors of the map.
    map_errors : MapErrors
        What the map may be off by.
    scales : NoiseScales
        How noisy odometry and detections turned out to be.
    by_noise : ndarray, shape (LEARNED, STATES, STATES)
        Part of `covariance` that comes from each of these noises.
    way_m : float
        Driven since the last image.
    still_s, moved_s : float
        Time since the last measurement in which the odometry stood, and in which it did not.
    hangs : bool
        Whether the odometry is taken to hang; `covariance` then allows for a motion meanwhile.

    """

    stamp_ns: int
    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray
    map_errors: MapErrors
    scales: NoiseScales
    by_noise: FloatArray
    way_m: float = 0.0
    still_s: float = 0.0
    moved_s: float = 0.0
    hangs: bool = False

    def estimate(self) -> PoseEstimate:
        """Return the pose of the base."""
        return PoseEstimate(self.stamp_ns, self.mean[:3].copy(), self.covariance[:3, :3].copy())

    @property
    def stands(self) -> bool:
        """Whether the robot has stood since the last measurement, as far as is known."""
        return self.still_s > 0.0 and self.moved_s == 0.0 and not self.hangs

    @property
    def side_slip(self) -> float:
        """Metres to the left per metre ahead."""
        return float(self.mean[_SLIP])

    @property
    def late(self) -> JointDelay:
        """Delay of the stamps of the joints, with its sigma."""
        return JointDelay(float(self.mean[DELAY]), float(np.sqrt(self.covariance[DELAY, DELAY])))


def initial_state(
    start: PoseEstimate,
    landmark_map: LandmarkMap,
    odometry: OdometryNoiseConfig,
    boresight_sigma: float,
    delay_sigma_s: float = 0.0,
    lens_sigma: float = 0.0,
) -> FilterState:
    """Return the state at a given pose, independent of the map."""
    wheels = *odometry.bias_sigmas, odometry.slip_sigma
    camera = boresight_sigma, delay_sigma_s, lens_sigma
    sigmas = np.array([*wheels, *camera, odometry.turn_loss_sigma_m_per_rad])
    covariance = np.zeros((STATES, STATES))
    covariance[:3, :3] = start.covariance
    covariance[range(3, STATES), range(3, STATES)] = sigmas**2
    by_noise = np.zeros((LEARNED, STATES, STATES))
    by_noise[SLIP, _SLIP, _SLIP] = odometry.slip_sigma**2
    mean, scales = np.array([*start.pose, *np.zeros(STATES - 3)]), NoiseScales.unknown(odometry)
    errors = MapErrors.of(landmark_map)
    cross = np.zeros((STATES, len(errors.estimate)))
    return FilterState(start.stamp_ns, mean, covariance, cross, errors, scales, by_noise)


def moved_to(state: FilterState, start: PoseEstimate) -> FilterState:
    """
    Return the state of the same robot at another pose.

    What was learned of its odometry and its camera stays; not what was seen of the map, which at a
    wrong place was wrong. The pose may come from a person, or from the camera; then its heading is
    off by the boresight. As it is not known which, the heading is corrected by half the boresight
    and widened by as much: the mean and covariance of a mixture of both cases. The next bearings
    tell.
    """
    kept = np.eye(STATES)
    kept[:3, :3] = 0.0
    kept[HEADING, BORESIGHT] = 0.5
    mean, covariance = kept @ state.mean, kept @ state.covariance @ kept.T
    mean[:3] += start.pose
    mean[HEADING] = wrap_rad(mean[HEADING])
    covariance[:3, :3] += start.covariance
    turned = state.mean[BORESIGHT] ** 2 + state.covariance[BORESIGHT, BORESIGHT]
    covariance[HEADING, HEADING] += 0.25 * turned
    moved = replace(
        state,
        stamp_ns=start.stamp_ns,
        mean=mean,
        covariance=covariance,
        cross=kept @ state.cross,
        by_noise=kept @ state.by_noise @ kept.T,
    )
    return unrefined(moved)


def widened(state: FilterState, which: int | list[int], variance: npt.ArrayLike) -> FilterState:
    """Return the state with `variance` added to the variances of the components `which`."""
    covariance = state.covariance.copy()
    covariance[which, which] += variance
    return replace(state, covariance=covariance)


def measured(state: FilterState) -> FilterState:
    """Return the state after a measurement, from which `still_s` and `moved_s` count anew."""
    return replace(state, still_s=0.0, moved_s=0.0)


def with_late_joints(state: FilterState, sigma_s: float, delay_s: float = 0.0) -> FilterState:
    """Return the state with a delay of the joint stamps of which nothing else is known."""
    mean, covariance, cross = state.mean.copy(), state.covariance.copy(), state.cross.copy()
    by_noise = state.by_noise.copy()
    cross[DELAY] = covariance[DELAY] = covariance[:, DELAY] = 0.0
    by_noise[:, DELAY] = by_noise[:, :, DELAY] = 0.0
    mean[DELAY], covariance[DELAY, DELAY] = delay_s, sigma_s**2
    return replace(state, mean=mean, covariance=covariance, cross=cross, by_noise=by_noise)


def with_map(state: FilterState, landmark_map: LandmarkMap) -> FilterState:
    """Return the state with the landmarks of a map, uncorrelated with them if they are others."""
    if state.map_errors.are_of(landmark_map):
        return state
    errors = MapErrors.of(landmark_map)
    return replace(state, cross=np.zeros((STATES, len(errors.estimate))), map_errors=errors)


def looking_again(state: FilterState, repeat_length_m: float, memory_m: float) -> FilterState:
    """
    Return the state with what is considered moved on by the way since the last image.

    Repeated errors are a first-order Gauss-Markov process with the correlation length
    `repeat_length_m`; what was seen of each landmark is forgotten alike, over `memory_m`.
    """
    if state.way_m == 0.0:
        return state
    again, known = np.exp(-state.way_m / np.array([repeat_length_m, memory_m])).tolist()
    errors, kept = state.map_errors.moved_on(known, again)
    return replace(state, cross=kept * state.cross, map_errors=errors, way_m=0.0)


def unrefined(state: FilterState) -> FilterState:
    """Return the state without what was seen of single landmarks."""
    errors, kept = state.map_errors.forgotten()
    if errors is state.map_errors:
        return state
    return replace(state, cross=kept * state.cross, map_errors=errors)


def propagate(
    state: FilterState, stamp_ns: int, motion: Motion, config: OdometryNoiseConfig
) -> FilterState:
    """Move on by odometry, corrected by its estimated systematic errors and side slip."""
    forward, left, turn = motion.increment
    way = float(np.hypot(forward, left))
    scale, drift, turn_scale, slip = state.mean[_SCALE:BORESIGHT]
    corrected = np.array(
        [
            (1.0 + scale) * forward - state.mean[TURN_LOSS] * abs(turn),
            (1.0 + scale) * left + slip * forward,
            (1.0 + turn_scale) * turn + drift * forward,
        ]
    )
    by_pose, by_motion = compose_jacobians(state.mean[:3], corrected)
    kept = np.exp(-way / config.slip_length_m)
    step = np.eye(STATES)
    step[:3, :3] = by_pose
    step[:3, _SCALE] = by_motion @ [forward, left, 0.0]
    step[:3, _SLIP] = by_motion[:, 1] * forward
    step[:3, TURN_LOSS] = -by_motion[:, 0] * abs(turn)
    step[2, _DRIFT], step[2, _TURN_SCALE] = forward, turn
    step[_SLIP, _SLIP] = kept

    mean = state.mean.copy()
    mean[:3] = compose(state.mean[:3], corrected)
    mean[_SLIP] *= kept
    scales = state.scales.moved(way, config)
    factors = scales.factors
    sensed = factors[:SLIP, None] * sensed_variances(motion, config)
    added = (by_motion * sensed[:, None]) @ by_motion.T
    slip_variance = factors[SLIP] * config.slip_sigma**2 * (1.0 - kept * kept)
    covariance = step @ state.covariance @ step.T
    covariance[:3, :3] += added.sum(axis=0)
    if state.hangs:
        motion = motion._replace(blind_seconds=motion.blind_seconds + motion.still_seconds)
    if not state.still_s + state.moved_s:
        # Later, jitter of the last pose is taken back by this one.
        covariance[:3, :3] += (by_motion * jitter_variances(motion)) @ by_motion.T
    if motion.blind_seconds > 0.0 or motion.ahead_s4 > 0.0:
        covariance[:3, :3] += (by_motion * blind_variances(motion, config)) @ by_motion.T
    covariance[_SLIP, _SLIP] += slip_variance
    by_noise = step @ state.by_noise @ step.T
    by_noise[:SLIP, :3, :3] += added
    by_noise[SLIP, _SLIP, _SLIP] += slip_variance
    wander = (config.bias_change_per_sqrt_m * config.bias_sigmas) ** 2 * way
    covariance[_BIASES, _BIASES] += np.diag(wander)
    return replace(
        state,
        stamp_ns=stamp_ns,
        mean=mean,
        covariance=covariance,
        cross=step @ state.cross,
        scales=scales,
        by_noise=by_noise,
        way_m=state.way_m + way,
        still_s=state.still_s + motion.still_seconds,
        moved_s=state.moved_s + motion.seconds - motion.still_seconds,
        hangs=state.hangs and motion.still_seconds >= motion.seconds,
    )
