"""
Prediction of the accuracy of a map, and of localization, for given positions of panoramas.

The positions of textures are unknown: wall samples stand for the expected number of landmarks
there, which scales their information.

Errors are propagated to first order, in plan: from poses of panoramas to landmarks by the model of
`learning.adjustment` (an own error of each landmark, and shared errors by the poses), and from
landmarks to the pose of the robot by bearings to all landmarks in view.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import observed_well
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment.depth_from_scale import INFORMATIVE
from landmark_nav.learning.adjustment.problem import AdjustmentConfig
from landmark_nav.learning.reference_area.common_errors import joined
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.planning.views import band_share, PlanConfig, Views, WallSamples
from landmark_nav.types import FloatArray

# Number of states of each panorama: x, y, heading. The offsets of walls follow after all of them.
_POSE = 3
# Greatest ratio of resolutions at which two panoramas show a patch alike.
_MOST_STRETCH = 4.0
# Landmarks that a fix needs.
_MIN_SEEN = 3.0


def landmark_errors(
    azimuth_rad: FloatArray,
    range_m: FloatArray,
    weight: FloatArray,
    normal: FloatArray,
    wall: npt.NDArray[np.intp],
    landmarks: FloatArray,
    pose_covariance: FloatArray,
    config: AdjustmentConfig,
) -> tuple[FloatArray, FloatArray]:
    """
    Errors of landmarks on walls after the adjustment of n panoramas.

    Azimuth in map, range and `weight` (n, s) are those of s points on walls from the panoramas;
    the weight is the information of a measurement, 1 / rad^2, 0 if there is none. `normal` (s, 2)
    and `wall` (s,) are normal and index of the wall of each point, `landmarks` (s,) is their
    number there, `pose_covariance` (3 n, 3 n) that of x, y and heading before the adjustment.
    Returns the covariance (s, 2, 2) of the own error of a landmark, and loadings (s, 2, m) of the
    shared errors; the factors have unit variance.
    """
    # Derivatives of azimuths by the landmark; by the panorama they have the opposite sign, by its
    # heading they are -1.
    turned = azimuth_rad + 0.5 * np.pi
    by_point = np.stack([np.cos(turned), np.sin(turned)], -1) / range_m[..., None]
    by_pose = np.concatenate([-by_point, np.full((*range_m.shape, 1), -1.0)], -1)
    hanging = 1.0 / (config.hanging_sigma_m**2 + config.relief_sigma_m**2)
    h_xx = np.einsum('ns,nsi,nsj->sij', weight, by_point, by_point)
    h_xx += hanging * normal[:, :, None] * normal[:, None]
    # A sigma of 30 m along the wall where no panorama looks, so that the matrix is not singular.
    h_xx += 1e-3 * np.eye(2)
    h_xp = np.einsum('ns,nsi,nsj->sinj', weight, by_point, by_pose)
    on_wall = np.eye(int(wall.max()) + 1)[wall]
    h_xw = -hanging * normal[..., None] * on_wall[:, None]
    h_xs = np.concatenate([h_xp.reshape(len(normal), 2, -1), h_xw], 2)
    own = np.linalg.inv(h_xx)
    gain = own @ h_xs

    shared = np.zeros((h_xs.shape[2], h_xs.shape[2]))
    blocks = np.einsum('s,ns,nsi,nsj->nij', landmarks, weight, by_pose, by_pose)
    poses, planes = slice(0, _POSE * len(blocks)), slice(_POSE * len(blocks), None)
    prior, each = np.linalg.inv(pose_covariance), np.arange(len(blocks))
    prior.reshape(len(blocks), _POSE, len(blocks), _POSE)[each, :, each] += blocks
    shared[poses, poses] = prior
    off_walls = (
        config.common_hanging_sigma_m**2 + np.eye(on_wall.shape[1]) * config.wall_sigma_m**2
    )
    shared[planes, planes] = np.linalg.inv(off_walls) + hanging * np.diag(landmarks @ on_wall)
    # Schur complement: information on poses and walls after elimination of the landmarks.
    factors = len(shared)
    reduction = (landmarks[:, None, None] * h_xs).reshape(-1, factors)
    shared -= reduction.T @ gain.reshape(-1, factors)
    return own, gain @ np.linalg.cholesky(np.linalg.inv(shared))


def localization_sigma(
    gradient: FloatArray,
    seen: FloatArray,
    own: FloatArray,
    loading: FloatArray,
    bearing_sigma_rad: float,
) -> FloatArray:
    """
    Localization error (c,) from bearings to all landmarks in view.

    It is the root of the trace of the covariance of the position, m; inf if fewer than three
    landmarks are in view, or if the position is not observable. `gradient` (c, s, 2) are those of
    the bearings by x and y of the viewer, at c floor cells; `seen` (c, s) landmarks are in view at
    each of s points, with the errors of `landmark_errors`.
    """
    gx, gy = gradient[..., 0], gradient[..., 1]
    variance = gx * gx * own[:, 0, 0] + 2.0 * gx * gy * own[:, 0, 1] + gy * gy * own[:, 1, 1]
    weight = seen / (variance + bearing_sigma_rad**2)
    wx, wy = weight * gx, weight * gy
    wxx, wxy, wyy = wx * gx, wx * gy, wy * gy

    # J^T R^-1 J for J = (g, -1) and R = D + U U^T with U = -g L, by Woodbury's identity.
    xx, xy, yy, x, y, one = (w.sum(axis=1) for w in (wxx, wxy, wyy, wx, wy, weight))
    direct = np.stack([xx, xy, -x, xy, yy, -y, -x, -y, one], -1).reshape(-1, 3, 3)
    lx, ly = loading[:, 0], loading[:, 1]
    cross = np.stack([-(wxx @ lx + wxy @ ly), -(wxy @ lx + wyy @ ly), wx @ lx + wy @ ly], 1)
    # Symmetric: only the upper half is computed.
    i, j = np.triu_indices(loading.shape[2])
    halves = [lx[:, i] * lx[:, j], lx[:, i] * ly[:, j] + ly[:, i] * lx[:, j], ly[:, i] * ly[:, j]]
    upper = np.concatenate([wxx, wxy, wyy], axis=1) @ np.concatenate(halves)
    shared = np.zeros((len(gx), loading.shape[2], loading.shape[2]))
    shared[:, i, j] = shared[:, j, i] = upper
    shared += np.eye(loading.shape[2])
    information = direct - cross @ np.linalg.solve(shared, np.swapaxes(cross, -1, -2))
    return _position_sigma(information, seen.sum(axis=1) >= _MIN_SEEN)


def _position_sigma(information: FloatArray, enough: npt.NDArray[np.bool_]) -> FloatArray:
    """Root of the trace (c,) of the position part of inverse information (c, 3, 3)."""
    sigma = np.full(len(information), np.inf)
    # The heading is eliminated first: what remains is 2 x 2.
    turn = np.maximum(information[:, 2, 2], 1e-12)
    arm = information[:, :2, 2]
    plane = information[:, :2, :2] - arm[:, :, None] * arm[:, None] / turn[:, None, None]
    xx, yy = plane[:, 0, 0], plane[:, 1, 1]
    det = xx * yy - plane[:, 0, 1] * plane[:, 1, 0]
    good = enough & (xx > 0.0) & (yy > 0.0)
    good &= det > 1e-9 * xx * yy
    sigma[good] = np.sqrt((xx[good] + yy[good]) / det[good])
    return sigma


# Probability that a patch is found in a second panorama. In seven simulated rooms (seeds 101 to
# 107, 1,356 patches) it is 97 %, constant up to 60 degrees of parallax, since both views are
# resampled on the wall. The decrease beyond that (parallax of half the probability, slope) is an
# assumption.
_MATCH_PROBABILITY = 0.97
_MATCH_HALF_RAD, _MATCH_SLOPE_RAD = 1.4, 0.12
# Sigmas of a match: position, pixels, and relative size.
_MATCH_SIGMA_PX = 0.08
_MATCH_SIGMA_SIZE = 3e-3
# Share of the reconstructed patches that no more salient one overlaps.
_KEPT_SHARE = 0.65
# Bound to which localization errors are clipped in the cost.
CAP_M = 0.05


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    Prediction for one set of positions of panoramas.

    Poses (n, 3) are those of the base, their covariance (n, 3, 3) is that of the pan axis by
    papers or panoramas. `landmarks` (s,) are expected at each wall sample, with a `covariance` (s,
    2, 2) of x and y. `sigma_m` is the localization error on the free floor, see
    `localization_sigma`.
    """

    poses_map_base: FloatArray
    pose_covariance: FloatArray
    landmarks: FloatArray
    covariance: FloatArray
    floor_xy: FloatArray
    sigma_m: FloatArray

    @property
    def landmark_sigma_m(self) -> float:
        """RMS error of landmarks; inf if there are none."""
        if not self.landmarks.sum():
            return float('inf')
        trace = np.trace(self.covariance, axis1=1, axis2=2)
        return float(np.sqrt(np.average(trace, weights=self.landmarks)))

    @property
    def cost_m(self) -> float:
        """Mean localization error over the floor, clipped to `CAP_M`."""
        return float(np.mean(np.minimum(self.sigma_m, CAP_M)))

    def quantile_m(self, share: float) -> float:
        """Quantile `share` of the localization error over the floor."""
        return float(np.quantile(self.sigma_m, share, method='inverted_cdf'))


class Predictor:
    """Predicts the localization error at floor `cells` (c, 2) for subsets of given panoramas."""

    def __init__(
        self, views: Views, samples: WallSamples, cells: FloatArray, room: Room, config: PlanConfig
    ) -> None:
        """Compute the values that do not depend on the subset."""
        self._views, self._samples, self._config = views, samples, config
        self._cells = cells
        self._gradient = bearing_gradients(cells, samples.xy)
        reach = np.linalg.norm(samples.xy - cells[:, None], axis=-1)
        triplet = config.triplet
        seen = room.visible(cells[:, None], samples.xy)
        seen &= (reach >= triplet.min_range_m) & (reach <= triplet.max_range_m)
        share = band_share(reach, float(views.eye[0, 2]), samples, config)
        # The heading of the robot is arbitrary: the camera sees only this share of all azimuths.
        share *= config.half_arc_rad / np.pi
        self._observed = np.zeros((len(views), *reach.shape), np.float32)
        self._alike = np.zeros((len(views), *views.range_m.shape), np.bool_)
        for p in range(len(views)):
            seen_before = (
                samples.xy,
                samples.normal,
                np.broadcast_to(views.eye[p], (len(samples.xy), 3)),
            )
            self._alike[p] = observed_well(
                *seen_before, views.eye, 1.0 / _MOST_STRETCH, _MOST_STRETCH
            )
            well = observed_well(*seen_before, cells, triplet.min_sampling, triplet.max_sampling)
            # Share of the heights in the panorama that are also in the image here.
            common = np.minimum(share / np.maximum(views.share[p], 1e-6), 1.0)
            self._observed[p] = np.where(seen & well, common, 0.0)

    def predict(self, places: npt.NDArray[np.intp]) -> Forecast:
        """Predict for a subset of indices (n,), n >= 2."""
        by_source, sighted = self._expected(places)
        config, views = self._config, self._views
        own, loading = landmark_errors(
            views.azimuth_rad[places],
            views.range_m[places],
            sighted / self._variance,
            self._samples.normal,
            self._samples.wall,
            by_source.sum(axis=0),
            joined(views.covariance[places], views.by_papers[places]),
            config.adjustment,
        )
        covariance = own + loading @ np.swapaxes(loading, -1, -2)
        largest = np.sqrt(np.linalg.eigvalsh(own)[:, -1])
        by_source = by_source * (largest <= config.election.max_sigma_m)
        seen = np.einsum('ncs,ns->cs', self._observed[places], by_source)
        bearing_sigma = config.triplet.bearing_sigma_rad
        sigma = localization_sigma(self._gradient, seen, own, loading, bearing_sigma)
        return Forecast(
            views.pose_map_base[places],
            views.covariance[places],
            by_source.sum(axis=0),
            covariance,
            self._cells,
            sigma,
        )

    def cost_m(self, places: npt.NDArray[np.intp]) -> float:
        """Mean clipped localization error for a subset of indices (n,)."""
        return self.predict(places).cost_m

    def _expected(self, places: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Expected landmarks (n, s) by proposing panorama, and measurements of each (n, s)."""
        config, views = self._config, self._views
        azimuth, share = views.azimuth_rad[places], views.share[places]
        parallax = np.abs(wrap_rad(azimuth[:, None] - azimuth))
        fall = (parallax - _MATCH_HALF_RAD) / _MATCH_SLOPE_RAD
        found = _MATCH_PROBABILITY / (1.0 + np.exp(np.clip(fall, -50.0, 50.0)))
        reach = views.range_m[places]
        approach = np.maximum(reach[:, None], reach) / np.minimum(reach[:, None], reach)
        in_line = parallax < config.stereo.min_parallax_rad
        found[in_line & (approach < config.stereo.min_approach)] = 0.0
        found[self._depth_sigma(places, parallax) > config.election.max_depth_sigma_m] = 0.0
        found[~self._alike[places[:, None], places]] = 0.0
        itself = np.arange(len(places))
        found[itself, itself] = 0.0
        # A patch in one panorama may be too high or too low for another.
        found *= np.minimum(share / np.maximum(share[:, None], 1e-6), 1.0)
        again = 1.0 - np.prod(1.0 - found, axis=1)
        by_source = _KEPT_SHARE * views.proposed[places] * again
        by_source *= min(1.0, config.election.max_count / max(by_source.sum(), 1e-9))
        # The proposing panorama measures its patch always, another one only if it is found there.
        given = found / np.maximum(again[:, None], 1e-9)
        given[itself, itself] = 1.0
        total = np.maximum(by_source.sum(axis=0), 1e-12)
        return by_source, np.einsum('ns,nms->ms', by_source, given) / total

    @property
    def _variance(self) -> float:
        """Variance of a measured azimuth, rad^2."""
        config = self._config
        matched = _MATCH_SIGMA_PX / config.focal_px
        return config.adjustment.azimuth_sigma_rad**2 + matched**2

    def _depth_sigma(self, places: npt.NDArray[np.intp], parallax_rad: FloatArray) -> FloatArray:
        """Depth error of a sample normal to its wall by two panoramas alone, m, (n, n, s)."""
        samples, reach = self._samples, self._views.range_m[places]
        way = self._views.eye[places, None, :2] - samples.xy
        cosine = np.sum(way * samples.normal, -1) / reach
        # By parallax: variance of the intersection of two rays.
        ray = reach[:, None] * cosine[None]
        square = (ray**2 + np.swapaxes(ray, 0, 1) ** 2) * self._variance
        # By the ratio of sizes, which also works without parallax.
        config = self._config
        size_sigma = np.hypot(_MATCH_SIGMA_SIZE, config.adjustment.nearness_sigma)
        nearness = 1.0 / np.maximum(reach * cosine, 1e-3)
        by_size = (nearness[:, None] - nearness) / size_sigma
        by_size[np.abs(by_size) * INFORMATIVE * config.election.max_depth_sigma_m < 1.0] = 0.0
        information = np.sin(parallax_rad) ** 2 / np.maximum(square, 1e-12) + by_size**2
        return np.asarray(1.0 / np.sqrt(np.maximum(information, 1e-12)))
