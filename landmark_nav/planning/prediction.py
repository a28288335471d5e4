"""
What a map learned from given places would be worth: landmarks, their errors, and the robot's.

Everything is an expectation over where on the walls texture may be: wall samples stand for the
landmarks to be expected there.

Errors to first order: from panoramas' poses to landmarks, from landmarks to the robot's place.

The models are those of `learning.adjustment` (what a landmark's error has alone, and what the
panoramas' poses give to all) and of bearings to everything that a turning camera sees, in
plan. Landmarks come in expected numbers, which scale their information.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.linalg import block_diag

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.patches import observed_well
from landmark_nav.geometry.walls import Room
from landmark_nav.learning.adjustment import AdjustmentConfig
from landmark_nav.learning.adjustment.depth_from_scale import INFORMATIVE
from landmark_nav.learning.reference_area import joined
from landmark_nav.localization.triangulation.model import bearing_gradients
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.views import band_share, Views, WallSamples
from landmark_nav.types import FloatArray

# x, y, heading of each panorama; after all of them, how far things hang off each wall.
_POSE = 3

# Landmarks that a fix needs.
_LEAST_SEEN = 3.0


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
    Errors of landmarks on walls that n panoramas show and an adjustment places.

    Parameters
    ----------
    azimuth_rad, range_m : ndarray, shape (n, s)
        Of s points on walls from the panoramas, in map.
    weight : ndarray, shape (n, s)
        Information of each measurement, 1 / rad^2; 0 where there is none.
    normal : ndarray, shape (s, 2)
        Of the walls.
    wall : ndarray of int, shape (s,)
        Which wall each is on.
    landmarks : ndarray, shape (s,)
        How many there are at each point.
    pose_covariance : ndarray, shape (3 n, 3 n)
        Joint one of x, y and heading of the panoramas, before the adjustment.
    config : AdjustmentConfig
        How exactly things hang on walls.

    Returns
    -------
    own : ndarray, shape (s, 2, 2)
        Covariance of what a landmark's error has alone.
    loading : ndarray, shape (s, 2, m)
        The rest, as unit-variance factors that all have in common.
    """
    # Of azimuths by the landmark; by the panorama it is the opposite, by heading -1.
    turned = azimuth_rad + 0.5 * np.pi
    by_point = np.stack([np.cos(turned), np.sin(turned)], -1) / range_m[..., None]
    by_pose = np.concatenate([-by_point, np.full((*range_m.shape, 1), -1.0)], -1)
    hanging = 1.0 / (config.hanging_sigma_m**2 + config.relief_sigma_m**2)
    h_xx = np.einsum('ns,nsi,nsj->sij', weight, by_point, by_point)
    h_xx += hanging * normal[:, :, None] * normal[:, None]
    # Nothing is known along the wall where no panorama looks: 30 m are as good as nothing.
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
    shared[poses, poses] = block_diag(*blocks) + np.linalg.inv(pose_covariance)
    off_walls = (
        config.common_hanging_sigma_m**2 + np.eye(on_wall.shape[1]) * config.wall_sigma_m**2
    )
    shared[planes, planes] = np.linalg.inv(off_walls) + hanging * np.diag(landmarks @ on_wall)
    # Schur complement: what is left of the information once every landmark is solved for.
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
    Localization error from bearings to all landmarks in view.

    Parameters
    ----------
    gradient : ndarray, shape (c, s, 2)
        Of the bearings by the viewer's x and y, at c places.
    seen : ndarray, shape (c, s)
        How many landmarks are seen at each of s points.
    own, loading : ndarray, shape (s, 2, 2), (s, 2, m)
        Their errors, as from `landmark_errors`.
    bearing_sigma_rad : float
        Standard deviation of a bearing.

    Returns
    -------
    ndarray, shape (c,)
        Root of the trace of the position's covariance, metres; inf where fewer than three are
        seen or they fix no place.
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
    # Symmetric: only the upper half is worked out.
    i, j = np.triu_indices(loading.shape[2])
    halves = [lx[:, i] * lx[:, j], lx[:, i] * ly[:, j] + ly[:, i] * lx[:, j], ly[:, i] * ly[:, j]]
    upper = np.concatenate([wxx, wxy, wyy], axis=1) @ np.concatenate(halves)
    shared = np.zeros((len(gx), loading.shape[2], loading.shape[2]))
    shared[:, i, j] = shared[:, j, i] = upper
    shared += np.eye(loading.shape[2])
    information = direct - cross @ np.linalg.solve(shared, np.swapaxes(cross, -1, -2))
    return _position_sigma(information, seen.sum(axis=1) >= _LEAST_SEEN)


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


# Fitted to seven simulated rooms (seeds 101 to 107, 1,356 patches): 97 % of the patches that a
# second panorama could show were found there, without a fall up to 60 degrees of parallax, as
# both views are resampled on the wall; where the fall lies beyond that is an assumption.
_MATCH_PROBABILITY = 0.97
_MATCH_HALF_RAD, _MATCH_SLOPE_RAD = 1.4, 0.12
# Standard deviations of a patch found again: of its place, and of how much larger it is shown.
_MATCH_SIGMA_PX = 0.08
_MATCH_SIGMA_SIZE = 3e-3
# Share of the reconstructed patches that no stronger one covers.
_KEPT_SHARE = 0.65
# Greater localization errors count as this much.
CAP_M = 0.05


@dataclass(frozen=True, eq=False)
class Forecast:
    """
    What panoramas at given places would be worth.

    Parameters
    ----------
    poses_map_base : ndarray, shape (n, 3)
        Where the robot stands.
    pose_covariance : ndarray, shape (n, 3, 3)
        Of the pan axis' x, y and heading as papers or panoramas give them.
    landmarks : ndarray, shape (s,)
        How many landmarks, for each wall sample.
    covariance : ndarray, shape (s, 2, 2)
        Of x and y of one there, as the map would state it.
    floor_xy, sigma_m : ndarray, shape (c, 2), (c,)
        Cells of the free floor, and the localization error there, root of the trace; inf where
        it is not known.
    """

    poses_map_base: FloatArray
    pose_covariance: FloatArray
    landmarks: FloatArray
    covariance: FloatArray
    floor_xy: FloatArray
    sigma_m: FloatArray

    @property
    def landmark_sigma_m(self) -> float:
        """Mean error of a landmark (root of the mean squared one), inf if there are none."""
        if not self.landmarks.sum():
            return float('inf')
        trace = np.trace(self.covariance, axis1=1, axis2=2)
        return float(np.sqrt(np.average(trace, weights=self.landmarks)))

    @property
    def cost_m(self) -> float:
        """Mean localization error over the floor, each counted as `CAP_M` at most."""
        return float(np.mean(np.minimum(self.sigma_m, CAP_M)))

    def quantile_m(self, share: float) -> float:
        """Localization error that `share` of the floor does not exceed."""
        return float(np.quantile(self.sigma_m, share, method='inverted_cdf'))


class Predictor:
    """
    Predicts for sets out of given places, seen from given cells of the floor.

    Parameters
    ----------
    views : Views
        The places, one or more, with what they see.
    cells : ndarray, shape (c, 2)
        Where the robot may have to find its place later.
    """

    def __init__(
        self,
        views: Views,
        samples: WallSamples,
        cells: FloatArray,
        room: Room,
        config: PlanConfig,
    ) -> None:
        """Work out what does not depend on the set."""
        self._views, self._samples, self._config = views, samples, config
        self._cells = cells
        self._gradient = bearing_gradients(cells, samples.xy)
        reach = np.linalg.norm(samples.xy - cells[:, None], axis=-1)
        triplet = config.triplet
        seen = room.visible(cells[:, None], samples.xy)
        seen &= (reach >= triplet.min_range_m) & (reach <= triplet.max_range_m)
        share = band_share(reach, float(views.eye[0, 2]), samples, config)
        # The robot may be turned any way: of all directions the camera can look in so many.
        share *= config.half_arc_rad / np.pi
        self._observed = np.zeros((len(views), *reach.shape), np.float32)
        self._alike = np.zeros((len(views), *views.range_m.shape), np.bool_)
        stretch = config.election.max_stretch
        for p in range(len(views)):
            seen_before = (
                samples.xy,
                samples.normal,
                np.broadcast_to(views.eye[p], (len(samples.xy), 3)),
            )
            self._alike[p] = observed_well(*seen_before, views.eye, 1.0 / stretch, stretch)
            well = observed_well(*seen_before, cells, triplet.min_sampling, triplet.max_sampling)
            # Of the heights that the panorama shows, those that are in the image here too.
            common = np.minimum(share / np.maximum(views.share[p], 1e-6), 1.0)
            self._observed[p] = np.where(seen & well, common, 0.0)

    def predict(self, places: npt.NDArray[np.intp]) -> Forecast:
        """Predict for a set of places (n,), n >= 2."""
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
        """Mean capped localization error of a set of places."""
        return self.predict(places).cost_m

    def _expected(self, places: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Landmarks (n, s) by the panorama that proposes them; where they are sighted (n, s)."""
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
        # A patch that one panorama shows may be too high or too low for another.
        found *= np.minimum(share / np.maximum(share[:, None], 1e-6), 1.0)
        again = 1.0 - np.prod(1.0 - found, axis=1)
        by_source = _KEPT_SHARE * views.proposed[places] * again
        by_source *= min(1.0, config.election.max_count / max(by_source.sum(), 1e-9))
        # The source shows its patch for sure, another panorama if it was found again there.
        given = found / np.maximum(again[:, None], 1e-9)
        given[itself, itself] = 1.0
        total = np.maximum(by_source.sum(axis=0), 1e-12)
        return by_source, np.einsum('ns,nms->ms', by_source, given) / total

    @property
    def _variance(self) -> float:
        """Of a measurement's azimuth."""
        config = self._config
        matched = _MATCH_SIGMA_PX / config.focal_px
        return config.adjustment.azimuth_sigma_rad**2 + matched**2

    def _depth_sigma(self, places: npt.NDArray[np.intp], parallax_rad: FloatArray) -> FloatArray:
        """How far off its wall two panoramas (n, n) alone would place a sample, (n, n, s)."""
        samples, reach = self._samples, self._views.range_m[places]
        way = self._views.eye[places, None, :2] - samples.xy
        cosine = np.sum(way * samples.normal, -1) / reach
        # Two bearings have the inverse information of their rays' directions.
        ray = reach[:, None] * cosine[None]
        square = (ray**2 + np.swapaxes(ray, 0, 1) ** 2) * self._variance
        # Sizes have it in line, too.
        config = self._config
        size_sigma = np.hypot(_MATCH_SIGMA_SIZE, config.adjustment.nearness_sigma)
        nearness = 1.0 / np.maximum(reach * cosine, 1e-3)
        by_size = (nearness[:, None] - nearness) / size_sigma
        by_size[np.abs(by_size) * INFORMATIVE * config.election.max_depth_sigma_m < 1.0] = 0.0
        information = np.sin(parallax_rad) ** 2 / np.maximum(square, 1e-12) + by_size**2
        return np.asarray(1.0 / np.sqrt(np.maximum(information, 1e-12)))
