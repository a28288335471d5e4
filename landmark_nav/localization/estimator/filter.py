"""
The joint estimator: pose, odometry, calibration, map and landmark errors in one state.

An iterated extended Kalman filter (`correction.py`). The shared factors of the map are part of the
state. The own error of a landmark joins the state when it is first seen; it is a first-order
Gauss-Markov process over the way, as it changes with the viewpoint, and leaves the state when
little of it is left. So repeated detections never make the pose more certain than the map allows.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from landmark_nav.arrays import IndexArray
from landmark_nav.calibration import Calibration, DEFAULT_SIGMAS, LENS, NAMES
from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.se2 import compose, compose_jacobians
from landmark_nav.localization.estimator import moved_objects
from landmark_nav.localization.estimator.config import EstimatorConfig, Step
from landmark_nav.localization.estimator.correction import corrected, usable
from landmark_nav.localization.estimator.factors import (
    CALIBRATION,
    CENTER,
    DELAY,
    FLOOR_TILT,
    FOCAL,
    ImagePoints,
    moved,
    ROLL,
    ROW_DELAY,
    SCALE,
    SLIP,
    STATES,
    TILT,
    TURN_LOSS,
    YAW,
)
from landmark_nav.localization.estimator.integrity import chance_log_evidence, MISSED
from landmark_nav.localization.estimator.noise import (
    FLOOR,
    NOISES,
    NoiseScales,
    SLIP_NOISE,
)
from landmark_nav.localization.estimator.state import MapErrors, OUTLIER, State, Update
from landmark_nav.localization.odometry.noise import (
    blind_variances,
    jitter_variances,
    Motion,
    OdometryNoiseConfig,
    sensed_variances,
    slip_variance,
)
from landmark_nav.localization.odometry.track import OdometryTrack
from landmark_nav.types import Expectation, FloatArray, LandmarkMap, PoseEstimate

# Own errors of landmarks leave the state when less than this share is left.
_STALE = 0.05
# Most landmarks with own errors in the state, which bounds the cost of an update.
_MOST_LANDMARKS = 60
# Fewest landmarks that support a step, as a turn of camera or base explains any two; their least
# weight.
_WITNESSES, _INLIER = 3, 0.3
# A heading that is known worse than this, rad, shows no slip of the wheels.
_OPEN_RAD = 0.02
# Log of the share of the likeliest hypothesis below which another is excluded: the risk of the
# protection level.
_EXCLUDED = float(np.log(0.01))
# Row of a landmark above or below the middle of an image, in focal lengths.
_TYPICAL_ROW = 0.25
# Sigmas of an unknown pose, m and rad.
_ANYWHERE = (3.0, 3.0, 2.0)
_TILTS, _DRIFTING = [FLOOR_TILT, FLOOR_TILT + 1], slice(SCALE, SLIP)
_CALIBRATED = np.arange(CALIBRATION, STATES)
# Sigma of what is given as exact, in m, rad, 1 or s: so that images show what they would change.
_EXACT = 1e-6
# Default sigmas with which images alone hardly show a quantity.
_HARDLY_SHOWN = 3.0


class _Hypothesis(NamedTuple):
    """What may have happened before an image: prediction, estimate, evidence."""

    prior: State
    after: Callable[[], State]
    update: Update


def _continued(
    new: State, mean: FloatArray, covariance: FloatArray, by_noise: FloatArray, before: State
) -> State:
    """Return a new state with these moments, and what was learned of noise and prior before."""
    return replace(
        new, mean=mean, covariance=covariance, by_noise=by_noise,
        scales=before.scales, corrections=before.corrections,
    )  # fmt: skip


def _passed_over(state: State, seen: ImagePoints) -> State:
    """Return the state after an image that is not used."""
    return replace(state, stamp_ns=max(state.stamp_ns, seen.stamp_ns))


class JointFilter:
    """
    Estimates pose and calibration of the robot from odometry and detections.

    Parameters
    ----------
    landmark_map : LandmarkMap
        Positions, own covariances and shared factors.
    calibration : Calibration
        Prior of the mount, lens and clocks.
    start : PoseEstimate
        Pose of the base in map, with its covariance.
    config : EstimatorConfig
        Noise of floor, map and mount.

    Attributes
    ----------
    state : State
        The current state; it may be set to an earlier one.
    predicted : State
        Prediction before the last image.
    still : ndarray, shape (m, 2, 2)
        Inverse prior covariances of the displacements of objects when they are first seen.
    """

    def __init__(
        self,
        landmark_map: LandmarkMap,
        calibration: Calibration,
        start: PoseEstimate,
        config: EstimatorConfig | None = None,
        odometry: OdometryNoiseConfig | None = None,
    ) -> None:
        self._config = config or EstimatorConfig()
        self._odometry = odometry or OdometryNoiseConfig()
        self._prior, self._map = calibration, landmark_map
        self._errors = MapErrors.of(landmark_map, movable=self._config.moved_probability > 0.0)
        self._fixed = self._errors.end
        # The prior of displacements may be final.
        self.still = moved_objects.isotropic(self._errors.objects.shape[1], moved_objects.STILL_M2)
        self._settled = False
        wheels = self._odometry
        floor_tilt = self._config.floor_tilt_sigma_rad
        variances = np.ones(self._fixed)
        variances[FLOOR_TILT:SCALE] = floor_tilt**2
        variances[SCALE:SLIP] = wheels.bias_sigmas**2
        variances[SLIP] = wheels.slip_m_per_rad**2
        variances[TURN_LOSS] = wheels.turn_loss_sigma_m_per_rad**2
        mean, covariance = np.zeros(self._fixed), np.diag(variances)
        mean[:3], covariance[:3, :3] = start.pose, start.covariance
        mean[CALIBRATION:STATES] = calibration.values
        covariance[CALIBRATION:STATES, CALIBRATION:STATES] = calibration.covariance
        covariance[_CALIBRATED, _CALIBRATED] += _EXACT**2 * (calibration.sigmas == 0.0)
        shared = calibration.by_map
        if shared is not None:
            # The map was learned with this calibration: their errors are correlated.
            covariance[CALIBRATION:STATES, STATES:] = shared
            covariance[STATES:, CALIBRATION:STATES] = shared.T
        by_noise = np.zeros((NOISES, STATES, STATES))
        by_noise[SLIP_NOISE, SLIP, SLIP] = wheels.slip_m_per_rad**2
        by_noise[FLOOR, _TILTS, _TILTS] = floor_tilt**2
        none, nothing = np.empty(0, dtype=np.intp), np.empty(0)
        on, still = np.empty((0, 0), dtype=np.bool_), np.empty((0, 2, 2))
        scales = NoiseScales.unknown(self._config.learning_sigma)
        self.state = State(
            start.stamp_ns, mean, covariance, by_noise, scales, none, nothing, none, still, on
        )
        self.predicted = self.state

    @property
    def estimate(self) -> PoseEstimate:
        """Pose of the base in map."""
        state = self.state
        return PoseEstimate(state.stamp_ns, state.mean[:3].copy(), state.covariance[:3, :3].copy())

    @property
    def expectation(self) -> Expectation:
        """Expected pose in an image of this time, with the covariance that its search needs."""
        state = self.state
        pose = compose(state.mean[:3], state.moved_back)
        axis = [*state.mean[CALIBRATION : CALIBRATION + 2], 0.0]
        by_base, _ = compose_jacobians(state.mean[:3], state.moved_back)
        by_pose, by_axis = compose_jacobians(pose, axis)
        rows = np.zeros((3, STATES))
        rows[:, :3] = by_pose @ by_base
        rows[:2, CALIBRATION : CALIBRATION + 2] = by_axis[:2, :2]
        rows[2, YAW] = 1.0
        covariance = rows @ state.covariance[:STATES, :STATES] @ rows.T
        which = [FLOOR_TILT, CALIBRATION + NAMES.index('axis_pitch'), TILT]
        tilt = float(np.sqrt(max(state.covariance[np.ix_(which, which)].sum(), 0.0)))
        turn_rate = float(state.speeds[2])
        return Expectation(state.stamp_ns, pose, covariance, self.calibration, tilt, turn_rate)

    def _with(self, state: State) -> JointFilter:
        other = copy(self)
        other.state = other.predicted = state
        return other

    def stepped(self) -> JointFilter:
        """Return the filter where base, camera or joint delay may have changed."""
        return self._with(self._stepped(self.state, self._config.knock))

    def knowing(self, still: FloatArray) -> JointFilter:
        """Return the filter where the priors (m, 2, 2) of all displacements are final."""
        other = self._with(self.state)
        other.still, other._settled = still, True
        return other

    def with_lens(self, given: Calibration) -> JointFilter:
        """Return the filter where the lens is as in `given`."""
        prior, state = self._prior.with_lens(given), self.state
        lens = np.isin(NAMES, LENS)
        rows = CALIBRATION + np.flatnonzero(lens)
        mean, covariance, by_noise = (
            values.copy() for values in (state.mean, state.covariance, state.by_noise)
        )
        covariance[rows] = covariance[:, rows] = 0.0
        by_noise[:, rows] = by_noise[:, :, rows] = 0.0
        mean[rows] = prior.values[lens]
        covariance[rows, rows] = np.maximum(prior.sigmas[lens], _EXACT) ** 2
        corrections = np.where(lens, 0.0, state.corrections)
        other = self._with(
            replace(
                state, mean=mean, covariance=covariance, by_noise=by_noise, corrections=corrections
            )
        )
        other._prior = prior
        return other

    def placed(self, start: PoseEstimate, pan_rate_rad_s: float | None = None) -> JointFilter:
        """
        Return the filter of the same robot at another pose.

        Estimates of wheels, mount, floor and map are kept, those of landmarks and objects are not.
        The errors of a pose that the camera found, turning at this rate to the left, are
        correlated with those of mount and delay.
        """
        other = JointFilter(self._map, self.calibration, start, self._config, self._odometry)
        mine, new = self.state, other.state
        mean, covariance = new.mean.copy(), new.covariance.copy()
        kept = slice(SCALE, self._fixed)
        mean[kept] = mine.mean[kept]
        covariance[kept, kept] = mine.covariance[kept, kept]
        by_mount = np.zeros((3, self._fixed - SCALE))
        if pan_rate_rad_s is not None:
            x, y = mean[CALIBRATION : CALIBRATION + 2].tolist()
            c, s = np.cos(mean[2]), np.sin(mean[2])
            by_mount[:2, CALIBRATION - SCALE : CALIBRATION - SCALE + 2] = [[-c, s], [-s, -c]]
            by_mount[:, YAW - SCALE] = -s * x - c * y, c * x - s * y, -1.0
            by_mount[:, DELAY - SCALE] = pan_rate_rad_s * by_mount[:, YAW - SCALE]
            with_mount = by_mount @ covariance[kept, kept]
            covariance[:3, kept], covariance[kept, :3] = with_mount, with_mount.T
            covariance[:3, :3] += with_mount @ by_mount.T
            # The offset of the optical centre had several directions during the search.
            covariance[[0, 1], [0, 1]] += np.diag(covariance)[CENTER : CENTER + 2].max()
            # A longer focal length brings the camera nearer to what it sees.
            away = self._errors.positions[:, :2] - mean[:2]
            square = 0.5 * np.sum(away**2) / max(len(away), 1)
            covariance[[0, 1], [0, 1]] += covariance[FOCAL, FOCAL] * square
            # A rolling shutter shifted landmarks by their rows.
            shift = covariance[ROW_DELAY, ROW_DELAY] * (_TYPICAL_ROW * pan_rate_rad_s) ** 2
            covariance[:3, :3] += shift * np.diag([square, square, 1.0])
        by_kept = np.eye(STATES)[:, SCALE:]
        by_kept[:3] = by_mount[:, : STATES - SCALE]
        by_noise = by_kept @ mine.by_noise[:, SCALE:, SCALE:] @ by_kept.T
        by_noise[FLOOR] += new.by_noise[FLOOR]
        new = replace(new, found=pan_rate_rad_s is not None)
        return other._with(_continued(new, mean, covariance, by_noise, mine))

    def on_map(self, landmark_map: LandmarkMap) -> JointFilter:
        """Return the filter of the same robot at the same pose, with new landmarks and objects."""
        other = JointFilter(
            landmark_map, self.calibration, self.estimate, self._config, self._odometry
        )
        mine, new = self.state, other.state
        mean, covariance = new.mean.copy(), new.covariance.copy()
        mean[:STATES] = mine.mean[:STATES]
        covariance[:STATES, :STATES] = mine.covariance[:STATES, :STATES]
        return other._with(_continued(new, mean, covariance, mine.by_noise, mine))

    @property
    def calibration(self) -> Calibration:
        """The current estimate of the calibration; exact values are those of the prior."""
        prior, mine = self._prior, slice(CALIBRATION, STATES)
        free = prior.sigmas > 0.0
        return replace(
            prior,
            values=np.where(free, self.state.mean[mine], prior.values),
            covariance=np.where(np.outer(free, free), self.state.covariance[mine, mine], 0.0),
            by_map=None,
        )

    @property
    def contradiction(self) -> tuple[str, float]:
        """
        Quantity of the prior that images contradict most, and by how many sigmas.

        Corrections by images are independent, and each has the variance by which it decreased
        that of the quantity: their sum tests the prior. What images hardly show is left out.
        """
        shift, variance = self.state.corrections
        prior = np.maximum(np.diag(self._prior.covariance), _EXACT**2)
        shown = variance > prior**2 / (prior + np.square(_HARDLY_SHOWN * DEFAULT_SIGMAS))
        sigmas = np.where(shown, np.abs(shift), 0.0) / np.sqrt(np.where(shown, variance, 1.0))
        k = int(np.argmax(sigmas))
        return NAMES[k], float(sigmas[k])

    @property
    def landmarks(self) -> FloatArray:
        """Current estimates (n, 3) of the positions of the map's landmarks."""
        state = self.state
        found = self._errors.positions + self._errors.loadings @ state.mean[STATES : self._fixed]
        found[state.landmarks] += state.mean[state.first_own :].reshape(-1, 3)
        found[state.landmarks, :2] += state.on @ state.mean[state.displacements(state.objects)]
        return np.asarray(found)

    @property
    def moved_objects(self) -> list[tuple[FloatArray, FloatArray]]:
        """Where objects (3,) were at learning that were moved since, and by how much (2,)."""
        state, objects = self.state, self._errors.objects
        moved = state.objects[moved_objects.moved(state, self._config.moved_sigma_m**2)]
        places = state.mean[state.displacements(moved)]
        return [
            (self._errors.positions[objects[:, each]].mean(axis=0), by)
            for each, by in zip(moved, places, strict=True)
        ]

    def look_back(self, track: OdometryTrack) -> None:
        """Take note of the motion of the base since an image of this time was taken."""
        if late_s := self._prior.base.image_delay_s:
            back = track.motion_back(self.state.stamp_ns, late_s)
            self.state = replace(self.state, moved_back=back)

    def mark(self) -> None:
        """Restart `carried`, the derivative by the present state."""
        self.state = replace(self.state, carried=np.eye(CALIBRATION))

    def forget_pose(self) -> None:
        """Widen the covariance of the pose to a large room."""
        covariance = self.state.covariance.copy()
        covariance[:3, :3] += np.diag(np.square(_ANYWHERE))
        self.state = replace(self.state, covariance=covariance)

    def kept(self, way_m: float) -> float:
        """Share of a landmark's own error that is left after a way."""
        return float(np.exp(-way_m / self._config.correlation_length_m))

    def move(self, stamp_ns: int, motion: Motion) -> None:
        """Predict by odometry."""
        state, wheels, config = self.state, self._odometry, self._config
        way = float(np.hypot(motion.increment[0], motion.increment[1]))
        scales = state.scales.moved(way)
        factors = scales.factors
        head, by_state, by_motion = moved(state.mean, motion)
        head[2] = wrap_rad(head[2])
        lengths = np.array([wheels.slip_length_m, config.floor_tilt_length_m])
        slips, floor_tilts = np.exp(-way / lengths).tolist()
        head[SLIP] *= slips
        head[FLOOR_TILT:SCALE] *= floor_tilts
        by_state[SLIP, SLIP] = slips
        by_state[_TILTS, _TILTS] = floor_tilts
        by_noise = state.by_noise.copy()
        by_noise[:, :CALIBRATION] = by_state @ by_noise[:, :CALIBRATION]
        by_noise[:, :, :CALIBRATION] = by_noise[:, :, :CALIBRATION] @ by_state.T
        added = np.zeros((NOISES, CALIBRATION, CALIBRATION))
        sensed = factors[:SLIP_NOISE, None] * sensed_variances(motion, wheels)
        added[:SLIP_NOISE, :3, :3] = (by_motion * sensed[:, None]) @ by_motion.T
        slip = factors[SLIP_NOISE] * slip_variance(motion, wheels) * (1.0 - slips**2)
        added[SLIP_NOISE, SLIP, SLIP] = slip
        floor = factors[FLOOR] * config.floor_tilt_sigma_rad**2 * (1.0 - floor_tilts**2)
        added[FLOOR, _TILTS, _TILTS] = floor
        by_noise[:, :CALIBRATION, :CALIBRATION] += added
        covariance = state.covariance.copy()
        covariance[:CALIBRATION] = by_state @ covariance[:CALIBRATION]
        covariance[:, :CALIBRATION] = covariance[:, :CALIBRATION] @ by_state.T
        covariance[:CALIBRATION, :CALIBRATION] += added.sum(axis=0)
        unseen = blind_variances(motion, wheels)
        if not state.seconds:
            # Jitter does not add up: the next pose takes back that of the last.
            unseen = unseen + jitter_variances(motion)
        covariance[:3, :3] += (by_motion * unseen) @ by_motion.T
        wander = (wheels.bias_change_per_sqrt_m * wheels.bias_sigmas) ** 2 * way
        covariance[_DRIFTING, _DRIFTING] += np.diag(wander)
        mean = state.mean.copy()
        mean[:CALIBRATION] = head
        self.state = replace(
            state,
            stamp_ns=stamp_ns,
            mean=mean,
            covariance=covariance,
            by_noise=by_noise,
            scales=scales,
            way_m=state.way_m + way,
            seconds=state.seconds + motion.seconds,
            speeds=motion.increment / motion.seconds if motion.seconds > 0.0 else state.speeds,
            carried=by_state @ state.carried,
        )

    def observe(self, seen: ImagePoints) -> Update:
        """
        Correct the state by the landmarks of one image.

        Invalid detections are left out: values that are not finite, landmarks that are not in the
        map, and second detections of a landmark.
        """
        seen = usable(seen, len(self._errors.positions))
        seen = replace(seen, moved_back=self.state.moved_back, speeds=self.state.speeds)
        if not len(seen):
            self.state = self.predicted = _passed_over(self.state, seen)
            return Update.of_nothing(seen)
        prior = self._with_landmarks(self._elapsed(self.state), seen.columns)
        new = ~(seen.columns[:, None] == self.state.landmarks).any(axis=1)
        expected = hypothesis = _Hypothesis(prior, *self._corrected(prior, seen, new))
        if not seen.lost and expected.update.surprising:
            hypothesis = self._likeliest(expected, seen, new)
        prior, correct, update = hypothesis
        # What chance explains as well, in windows that large, must not move the pose.
        unused = update.log_ratios.sum() + MISSED * len(seen.missed) < 0.0 or (
            expected.update.surprising
            and update.log_evidence
            < chance_log_evidence(expected.update.residual, expected.update.covariance)
        )
        if unused:
            prior, update = prior if update.stepped else expected.prior, update.unused
            correct = partial(_passed_over, prior, seen)
        after = correct()
        if unused:
            # The image says nothing of its new landmarks, which stay new.
            after = after.only(~np.isin(after.landmarks, seen.columns[new]))
            after = replace(after, found=self.state.found)
        else:
            after = self._with_moved(after, update, new).corrected_from(prior)
            if not self._settled:
                config = self._config
                after = moved_objects.weighed(
                    after, config.moved_log_odds, config.moved_sigma_m**2
                )
        self.state, self.predicted = after, prior
        return update

    def _likeliest(
        self, expected: _Hypothesis, seen: ImagePoints, new: npt.NDArray[np.bool_]
    ) -> _Hypothesis:
        """Return what most likely happened before a surprising image, or cannot be excluded."""
        prior = expected.prior
        # After a knock the pose is open, and many slips in a row would close it wrongly.
        known = prior.covariance[2, 2] < _OPEN_RAD**2
        hypotheses = [expected]
        for causes, step in self._config.steps:
            if not (known or step.calibration):
                continue
            opened = self._stepped(prior, step)
            after, update = self._corrected(opened, seen, new)
            # A knock is no slip: many sigmas of it cost less than the prior of a knock.
            unlike = not step.calibration and update.surprising
            if (update.weight > _INLIER).sum() >= _WITNESSES and not unlike:
                evidence = max(
                    cause.log_odds
                    + self._corrected(self._stepped(prior, cause), seen, new)[1].log_evidence
                    for cause in causes
                )
                update = update._replace(log_evidence=evidence, stepped=bool(step.calibration))
                hypotheses.append(_Hypothesis(opened, after, update))
        moved = expected if self._settled else self._objects_moved(expected, seen, new)
        hypotheses.append(moved)
        # What asks for caution counts unless it can be excluded: an object that was moved says
        # little, and a knock leaves all open, the focal length too unless that can be excluded.
        best = max(each.update.log_evidence for each in hypotheses)
        possible = [each for each in hypotheses if each.update.log_evidence >= best + _EXCLUDED]
        stepped = [each for each in possible if each.update.stepped]
        cautious = [*stepped, *(k for k in possible if k is moved and moved is not expected)]
        chosen = max(cautious or possible, key=lambda each: each.update.log_evidence)
        if chosen.update.stepped:
            chosen = stepped[-1]
        return chosen._replace(update=chosen.update._replace(log_evidence=best))

    def _objects_moved(
        self, expected: _Hypothesis, seen: ImagePoints, new: npt.NDArray[np.bool_]
    ) -> _Hypothesis:
        """Objects were moved: all that may have been, with the evidence of the likeliest."""
        likeliest, gained, opened = expected, 0.0, list[int]()
        wide = moved_objects.isotropic(1, moved_objects.STILL_M2 + self._config.moved_sigma_m**2)
        shown = np.flatnonzero(self._errors.objects[seen.columns].any(axis=0))
        while likeliest.update.surprising:
            prior, trials = likeliest.prior, []
            still = prior.still.trace(axis1=1, axis2=2) > 2.0 * wide.trace(axis1=1, axis2=2)
            for each in np.intersect1d(shown, prior.objects[still]):
                trial, past = moved_objects.exchanged(prior, np.array([each]), wide)
                after, update = self._corrected(trial, seen, new)
                past += gained + self._config.moved_log_odds
                update = update._replace(log_evidence=update.log_evidence + past)
                trials.append((update.log_evidence, each, past, _Hypothesis(trial, after, update)))
            top, _, past, best = max(trials, default=(-np.inf, 0, 0.0, likeliest))
            if top < likeliest.update.log_evidence:
                break
            opened += [each for evidence, each, *_ in trials if evidence >= top + _EXCLUDED]
            likeliest, gained = best, past
        if not opened:
            return expected
        which = np.unique(opened)
        prior, _ = moved_objects.exchanged(
            expected.prior, which, np.repeat(wide, len(which), axis=0)
        )
        after, update = self._corrected(prior, seen, new)
        # Such an image is less evidence for the place, down to none.
        gained = max(gained, -max(float(update.log_ratios.sum()), 0.0))
        update = update._replace(
            log_evidence=likeliest.update.log_evidence,
            log_ratios=update.log_ratios + gained / len(seen),
        )
        return _Hypothesis(prior, after, update)

    def _with_moved(self, state: State, update: Update, new: npt.NDArray[np.bool_]) -> State:
        """Return the state with wider own errors of new landmarks that are found to be off."""
        looser = 1.0 / update.weight[new]
        if not (looser > 1.0).any():
            return state
        # An outlier says nothing of its landmark, which stays new.
        columns, out = update.columns[new], update.weight[new] <= OUTLIER
        state = state.only(~np.isin(state.landmarks, columns[out]))
        columns, wider = columns[~out], looser[~out] - 1.0
        slots = np.nonzero(columns[:, None] == state.landmarks)[1]
        places = state.first_own + 3 * slots[:, None] + np.arange(3)
        covariance = state.covariance.copy()
        added = wider[:, None, None] * self._errors.own[columns]
        covariance[places[:, :, None], places[:, None]] += added
        return replace(state, covariance=covariance)

    def _corrected(
        self, state: State, seen: ImagePoints, new: npt.NDArray[np.bool_]
    ) -> tuple[Callable[[], State], Update]:
        pan_sigma_rad = self._prior.base.pan_sigma_rad
        return corrected(state, seen, self._errors, new, pan_sigma_rad, self._config.tail_freedom)

    def _stepped(self, state: State, step: Step) -> State:
        """Return the state where the base or the calibration may have changed by so much."""
        covariance = state.covariance.copy()
        covariance[[0, 1], [0, 1]] += step.sigma_m**2
        covariance[2, 2] += step.sigma_rad**2
        for name, sigma in step.calibration.items():
            k = CALIBRATION + NAMES.index(name)
            # What is given as exact stays.
            if covariance[k, k] > _EXACT**2:
                covariance[k, k] += sigma**2
        return replace(state, covariance=covariance)

    def _elapsed(self, state: State) -> State:
        """Predict the errors of landmarks and mount over way and time since the last image."""
        if not (state.way_m or state.seconds):
            return state
        kept, first = self.kept(state.way_m), state.first_own
        unseen = state.unseen_m + state.way_m
        left = np.ones(len(state.mean))
        left[first:] = kept
        mean, covariance = left * state.mean, left[:, None] * state.covariance
        covariance *= left
        places = first + np.arange(3 * len(state.landmarks)).reshape(-1, 3)
        fresh = (1.0 - kept**2) * self._errors.own[state.landmarks]
        covariance[places[:, :, None], places[:, None]] += fresh
        mount = self._config.mount_walk_rad_per_sqrt_s
        for k, walk in (
            (YAW, mount),
            (ROLL, mount),
            (TILT, self._config.tilt_walk_rad_per_sqrt_s),
        ):
            # Exact values do not change.
            if covariance[k, k] > _EXACT**2:
                covariance[k, k] += walk**2 * state.seconds
        return replace(
            state, mean=mean, covariance=covariance, unseen_m=unseen, way_m=0.0, seconds=0.0
        )

    def _with_landmarks(self, state: State, columns: IndexArray) -> State:
        """Return the state with own errors of these landmarks, and without stale ones."""
        seen, known = np.zeros((2, len(self._errors.positions)), dtype=np.bool_)
        seen[columns], known[state.landmarks] = True, True
        present = seen[state.landmarks]
        far = -self._config.correlation_length_m * np.log(_STALE)
        kept = present | (state.unseen_m < far)
        new = columns[~known[columns]]
        excess = int(kept.sum()) + len(new) - _MOST_LANDMARKS
        if excess > 0:
            # Remove those that were not seen for the longest way.
            others = np.flatnonzero(kept & ~present)
            kept[others[np.argsort(-state.unseen_m[others], kind='stable')[:excess]]] = False
        state = replace(state, unseen_m=np.where(present, 0.0, state.unseen_m)).only(kept)
        if not len(new):
            return state
        landmarks = np.concatenate([state.landmarks, new])
        on = self._errors.objects[landmarks]
        objects = np.flatnonzero(on.any(axis=0))
        first_own = self._fixed + 2 * len(objects)
        size = first_own + 3 * (len(state.landmarks) + len(new))
        mean, covariance = np.zeros(size), np.zeros((size, size))
        at = self._fixed + 2 * np.arange(len(objects))[:, None] + np.arange(2)
        before = np.searchsorted(objects, state.objects)
        own = first_own + np.arange(3 * len(state.landmarks))
        places = np.concatenate([np.arange(self._fixed), at[before].ravel(), own])
        mean[places], covariance[np.ix_(places, places)] = state.mean, state.covariance
        joining = np.setdiff1d(np.arange(len(objects)), before)
        variances = np.linalg.inv(self.still[objects])
        covariance[at[joining][:, :, None], at[joining][:, None]] = variances[joining]
        places = first_own + 3 * len(state.landmarks) + np.arange(3 * len(new)).reshape(-1, 3)
        covariance[places[:, :, None], places[:, None]] = self._errors.own[new]
        still = self.still[objects]
        found = state.found and len(columns) >= _WITNESSES
        if found:
            # The pose was found by landmarks like these, and is off by what they are off by.
            shares = on.mean(axis=0)[objects][:, None, None]
            shared = shares * variances
            covariance[at, :2], covariance[:2, at] = shared, shared.transpose(2, 0, 1)
            covariance[:2, :2] += (shares * shared).sum(axis=0)
        still[before] = state.still
        return replace(
            state,
            mean=mean,
            covariance=covariance,
            landmarks=landmarks,
            unseen_m=np.concatenate([state.unseen_m, np.zeros(len(new))]),
            objects=objects,
            still=still,
            on=on[:, objects],
            found=state.found and not found,
        )
