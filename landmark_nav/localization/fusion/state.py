"""
The Schmidt-Kalman state, and how it moves on, as pure functions.

Schmidt, Application of State-Space Methods to Navigation Problems, 1966: landmarks are consider
states. Their errors and their correlations with the pose are carried along, but their places are
not estimated, so repeated sightings never claim more than the map knows. So is what the sightings
of one landmark repeat from picture to picture: seen from nearly the same place, a patch is found
off by nearly the same fraction of a pixel. On request both are estimated too
(`measurement.correct` with `refine`), which is EKF-SLAM with the map as its prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.localization.fusion.noise import LEARNED, NoiseScales, SLIP, WHEELS
from landmark_nav.localization.joint_delay import JointDelay
from landmark_nav.localization.odometry.noise import (
    blind_variances,
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
    'among',
    'initial_state',
    'looking_again',
    'measured',
    'moved_to',
    'propagate',
    'widened',
    'with_late_joints',
]

# x, y, heading; scale of the way, drift per metre, scale of turns; side slip; boresight; by how
# much the stamps of the joints are late; principal point over focal length; way lost in turns.
STATES = 11
HEADING, BORESIGHT, DELAY, LENS, TURN_LOSS = 2, 7, 8, 9, 10
_SCALE, _DRIFT, _TURN_SCALE, _SLIP = 3, 4, 5, 6
# Of those, the pose.
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
    cross : ndarray, shape (STATES, 3n)
        Covariance of `mean` with the landmarks' (x, y), then with what sightings of each repeat.
    landmarks : ndarray, shape (n, 2)
        Their places in map, metres.
    repeated : ndarray, shape (n,)
        Error that the sightings of each repeat, over its sigma.
    considered_covariance : ndarray, shape (3n, 3n)
        Joint covariance of both, in the order of `cross`.
    scales : NoiseScales
        How noisy odometry and sightings turned out to be.
    by_noise : ndarray, shape (LEARNED, STATES, STATES)
        What of `covariance` comes from each of those noises.
    way_m : float
        Since the last picture.
    still_s, moved_s : float
        Time since the last measurement in which the odometry stood, and in which it did not.
    hangs : bool
        Whether that stand is doubted; then `covariance` holds all that may have happened in it.

    """

    stamp_ns: int
    mean: FloatArray
    covariance: FloatArray
    cross: FloatArray
    landmarks: FloatArray
    repeated: FloatArray
    considered_covariance: FloatArray
    scales: NoiseScales
    by_noise: FloatArray
    way_m: float = 0.0
    still_s: float = 0.0
    moved_s: float = 0.0
    hangs: bool = False

    def estimate(self) -> PoseEstimate:
        """Return the pose alone."""
        return PoseEstimate(self.stamp_ns, self.mean[:3].copy(), self.covariance[:3, :3].copy())

    @property
    def stands(self) -> bool:
        """Whether the robot has stood since the last measurement, as far as is known."""
        return self.still_s > 0.0 and self.moved_s == 0.0 and not self.hangs

    @property
    def late(self) -> JointDelay:
        """Of the stamps of the joints."""
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
    mean, nothing = np.array([*start.pose, *np.zeros(STATES - 3)]), np.empty(0)
    scales = NoiseScales.unknown(odometry)
    alone = FilterState(
        start.stamp_ns, mean, covariance, nothing, nothing, nothing, nothing, scales, by_noise
    )
    return among(alone, landmark_map)


def moved_to(state: FilterState, start: PoseEstimate) -> FilterState:
    """
    Return the state of the same robot at another pose.

    What was learned of its odometry and its camera stays. Who tells the pose is not known: the
    camera, which has its heading off by as much as it is turned against the base, or a person.
    So that much of the heading is open: it lies half way, by these two as a mixture. The next
    bearings tell it.
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
    return replace(
        state,
        stamp_ns=start.stamp_ns,
        mean=mean,
        covariance=covariance,
        cross=kept @ state.cross,
        by_noise=kept @ state.by_noise @ kept.T,
    )


def widened(state: FilterState, which: int | list[int], variance: npt.ArrayLike) -> FilterState:
    """Return the state with so much added to the variances of some of its numbers."""
    covariance = state.covariance.copy()
    covariance[which, which] += variance
    return replace(state, covariance=covariance)


def measured(state: FilterState) -> FilterState:
    """Return the state after a measurement: time is counted from there."""
    return replace(state, still_s=0.0, moved_s=0.0)


def with_late_joints(state: FilterState, sigma_s: float) -> FilterState:
    """Return the state of a robot whose joint states may be late or early by `sigma_s`."""
    mean, covariance, cross = state.mean.copy(), state.covariance.copy(), state.cross.copy()
    mean[DELAY] = cross[DELAY] = covariance[DELAY] = covariance[:, DELAY] = 0.0
    covariance[DELAY, DELAY] = sigma_s**2
    return replace(state, mean=mean, covariance=covariance, cross=cross)


def among(state: FilterState, landmark_map: LandmarkMap) -> FilterState:
    """Return the state among other landmarks, independent of them."""
    n = len(landmark_map.landmarks)
    return replace(
        state,
        cross=np.zeros((STATES, 3 * n)),
        landmarks=landmark_map.positions[:, :2],
        repeated=np.zeros(n),
        considered_covariance=block_diag(landmark_map.joint_covariance_xy, np.eye(n)),
    )


def looking_again(state: FilterState, length_m: float) -> FilterState:
    """
    Return the state as a picture finds it: sightings repeat less of their errors after some way.

    A first-order Gauss-Markov process of the way, over `length_m`.
    """
    if state.way_m == 0.0:
        return state
    kept, repeats = np.exp(-state.way_m / length_m), slice(2 * len(state.landmarks), None)
    cross, covariance = state.cross.copy(), state.considered_covariance
    cross[:, repeats] *= kept
    if state.repeated.any():
        covariance = covariance.copy()
        covariance[repeats] *= kept
        covariance[:, repeats] *= kept
        covariance[repeats, repeats] += (1.0 - kept**2) * np.eye(len(state.landmarks))
    return replace(
        state,
        cross=cross,
        repeated=kept * state.repeated,
        considered_covariance=covariance,
        way_m=0.0,
    )


def propagate(
    state: FilterState, stamp_ns: int, motion: Motion, config: OdometryNoiseConfig
) -> FilterState:
    """Move on by odometry, corrected by what is known of its systematic errors and its slip."""
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
    added = (by_motion * (factors[WHEELS] * sensed_variances(motion, config))) @ by_motion.T
    slip_variance = factors[SLIP] * config.slip_sigma**2 * (1.0 - kept * kept)
    covariance = step @ state.covariance @ step.T
    covariance[:3, :3] += added
    if state.hangs:
        motion = motion._replace(blind_seconds=motion.blind_seconds + motion.still_seconds)
    if motion.blind_seconds > 0.0 or motion.ahead_s4 > 0.0:
        covariance[:3, :3] += (by_motion * blind_variances(motion, config)) @ by_motion.T
    covariance[_SLIP, _SLIP] += slip_variance
    by_noise = step @ state.by_noise @ step.T
    by_noise[WHEELS, :3, :3] += added
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
