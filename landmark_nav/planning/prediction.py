"""
What a map learned from given places would be worth: landmarks, their errors, and the robot's.

Everything is an expectation to first order, over where on the walls texture may be: wall samples
stand for the landmarks to be expected there. The error models are those of `learning.adjustment`
(own errors, and those that the panoramas' poses give to all landmarks) and of bearings to
all landmarks that a turning camera sees from a place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.observation import observed_well
from landmark_nav.geometry.walls import Room
from landmark_nav.localization.triangulation_model import bearing_gradients
from landmark_nav.planning.config import PlanConfig
from landmark_nav.planning.room_grid import WallSamples
from landmark_nav.planning.views import band_share, Views
from landmark_nav.types import FloatArray

__all__ = ['Prediction', 'Predictor']

# x, y, heading of each panorama; after all of them, how far things hang off the walls.
_POSE = 3


@dataclass(frozen=True, eq=False)
class Prediction:
    """
    What is to be expected of one set of places.

    Parameters
    ----------
    landmarks : ndarray, shape (s,)
        How many landmarks, for each wall sample.
    covariance : ndarray, shape (s, 2, 2)
        Of x and y of one there, as the map would state it.
    sigma_m : ndarray, shape (c,)
        Localization error at each floor cell, root of the trace; inf where it can't be told.

    """

    landmarks: FloatArray
    covariance: FloatArray
    sigma_m: FloatArray

    @property
    def landmark_sigma_m(self) -> float:
        """Mean error of a landmark (root of the mean squared one), inf if there are none."""
        if not self.landmarks.sum():
            return float('inf')
        trace = np.trace(self.covariance, axis1=1, axis2=2)
        return float(np.sqrt(np.average(trace, weights=self.landmarks)))

    def cost_m(self, cap_m: float) -> float:
        """Mean localization error over the floor, each counted as `cap_m` at most."""
        return float(np.mean(np.minimum(self.sigma_m, cap_m)))


class Predictor:
    """
    Predicts for sets out of given places, seen from given cells of the floor.

    Parameters
    ----------
    views : Views
        The places, with what they see.
    samples : WallSamples
        What there is to see.
    cells : ndarray, shape (c, 2)
        Where the robot may have to find its place later.
    room : Room
        Walls that hide.
    config : PlanConfig
        Error models and bounds.

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
        gradient = bearing_gradients(cells, samples.xy)
        gx, gy = gradient[..., 0], gradient[..., 1]
        self._basis = np.stack([gx * gx, gx * gy, gy * gy, gx, gy, np.ones_like(gx)], -1)

        reach = np.linalg.norm(samples.xy - cells[:, None], axis=-1)
        triplet = config.triplet
        seen = room.visible(cells[:, None], samples.xy)
        seen &= (reach >= triplet.min_range_m) & (reach <= triplet.max_range_m)
        eyes = views.eye[0, 2] if len(views) else 0.0
        share = band_share(reach, eyes, samples, config)
        self._observed = np.zeros((len(views), *reach.shape), np.float32)
        for p in range(len(views)):
            well = observed_well(
                samples.xy,
                samples.normal,
                np.broadcast_to(views.eye[p], (len(samples.xy), 3)),
                cells,
                triplet.min_sampling,
                triplet.max_sampling,
            )
            # Of the heights that the panorama shows, those that are in the picture here too.
            common = np.minimum(share / np.maximum(views.share[p], 1e-6), 1.0)
            self._observed[p] = np.where(seen & well, common, 0.0)

    def predict(self, places: npt.NDArray[np.intp]) -> Prediction:
        """Predict for a set of places (n,), n >= 2."""
        by_source, sighted = self._expected(places)
        own, loading = self._errors(places, by_source.sum(axis=0), sighted)
        covariance = own + loading @ np.swapaxes(loading, -1, -2)
        largest = np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])
        by_source = by_source * (largest <= self._config.election.max_sigma_m)
        sigma = self._localization(places, by_source, own, loading)
        return Prediction(by_source.sum(axis=0), covariance, sigma)

    def cost_m(self, places: npt.NDArray[np.intp]) -> float:
        """Mean capped localization error of a set of places."""
        return self.predict(places).cost_m(self._config.cap_m)

    def _expected(self, places: npt.NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
        """Landmarks (n, s) by the panorama that proposes them; where they are sighted (n, s)."""
        config, views = self._config, self._views
        azimuth, share = views.azimuth_rad[places], views.share[places]
        parallax = np.abs(wrap_rad(azimuth[:, None] - azimuth))
        fall = (parallax - config.match_half_rad) / config.match_slope_rad
        found = config.match_probability / (1.0 + np.exp(np.clip(fall, -50.0, 50.0)))
        found[parallax < config.stereo.min_parallax_rad] = 0.0
        itself = np.arange(len(places))
        found[itself, itself] = 0.0
        # A patch that one panorama shows may be too high or too low for another.
        found *= np.minimum(share / np.maximum(share[:, None], 1e-6), 1.0)
        again = 1.0 - np.prod(1.0 - found, axis=1)
        by_source = config.kept_share * views.proposed[places] * again
        by_source *= min(1.0, config.election.max_count / max(by_source.sum(), 1e-9))
        # The source shows its patch for sure, another panorama if it was found again there.
        given = found / np.maximum(again[:, None], 1e-9)
        given[itself, itself] = 1.0
        total = np.maximum(by_source.sum(axis=0), 1e-12)
        return by_source, np.einsum('ns,nms->ms', by_source, given) / total

    def _errors(
        self, places: npt.NDArray[np.intp], landmarks: FloatArray, sighted: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Own covariance (s, 2, 2) of landmarks and loading (s, 2, m) by what they share."""
        config, views, n = self._config, self._views, len(places)
        variance = config.adjustment.azimuth_sigma_rad**2
        variance += (config.match_sigma_px / config.focal_px) ** 2
        weight = sighted / variance
        # Of azimuths by the landmark; by the panorama it is the opposite, by heading -1.
        reach = views.range_m[places]
        turned = views.azimuth_rad[places] + 0.5 * np.pi
        by_point = np.stack([np.cos(turned), np.sin(turned)], -1) / reach[..., None]
        by_pose = np.concatenate([-by_point, np.full((*reach.shape, 1), -1.0)], -1)

        normal = self._samples.normal
        wall = config.adjustment.hanging_sigma_m**-2.0
        h_xx = np.einsum('ns,nsi,nsj->sij', weight, by_point, by_point)
        h_xx += wall * normal[:, :, None] * normal[:, None]
        # Nothing is known along the wall where no panorama looks: 30 m are as good as nothing.
        h_xx += 1e-3 * np.eye(2)
        h_xp = np.einsum('ns,nsi,nsj->sinj', weight, by_point, by_pose)
        h_xs = np.concatenate(
            [h_xp.reshape(len(normal), 2, -1), -wall * normal[..., None]], axis=2
        )
        own = np.linalg.inv(h_xx)
        gain = own @ h_xs

        m = _POSE * n + 1
        h_ss = np.zeros((m, m))
        blocks = np.einsum('s,ns,nsi,nsj->nij', landmarks, weight, by_pose, by_pose)
        blocks += np.linalg.inv(views.covariance[places])
        for k, block in enumerate(blocks):
            part = slice(_POSE * k, _POSE * (k + 1))
            h_ss[part, part] = block
        h_ss[-1, -1] = config.adjustment.common_hanging_sigma_m**-2.0 + wall * landmarks.sum()
        h_ss -= np.einsum('s,sip,siq->pq', landmarks, h_xs, gain)
        return own, gain @ np.linalg.cholesky(np.linalg.inv(h_ss))

    def _localization(
        self,
        places: npt.NDArray[np.intp],
        by_source: FloatArray,
        own: FloatArray,
        loading: FloatArray,
    ) -> FloatArray:
        """Root of the trace (c,) of the position covariance from all landmarks in view."""
        basis = self._basis
        seen = np.einsum('ncs,ns->cs', self._observed[places], by_source)
        own_parts = np.stack([own[:, 0, 0], 2.0 * own[:, 0, 1], own[:, 1, 1]], -1)
        variance = np.einsum('csk,sk->cs', basis[..., :3], own_parts)
        variance += self._config.triplet.bearing_sigma_rad**2
        weighted = basis * (seen / variance)[..., None]

        # Information J^T R^-1 J with R = D + U U^T, U = -g L (Woodbury).
        xx, xy, yy, x, y, one = np.moveaxis(weighted.sum(axis=1), -1, 0)
        direct = np.stack([xx, xy, -x, xy, yy, -y, -x, -y, one], -1).reshape(-1, 3, 3)
        count, m = len(basis), loading.shape[2]
        lx, ly = loading[:, 0], loading[:, 1]
        by_sample = np.moveaxis(weighted, -1, 0)
        to_x = by_sample[0] @ lx + by_sample[1] @ ly
        to_y = by_sample[1] @ lx + by_sample[2] @ ly
        to_heading = by_sample[3] @ lx + by_sample[4] @ ly
        cross = np.stack([-to_x, -to_y, to_heading], 1)
        square = np.stack(
            [
                lx[:, :, None] * lx[:, None],
                lx[:, :, None] * ly[:, None] + ly[:, :, None] * lx[:, None],
                ly[:, :, None] * ly[:, None],
            ]
        ).reshape(3, len(lx), m * m)
        shared = np.eye(m) + (by_sample[:3] @ square).sum(axis=0).reshape(count, m, m)
        information = direct - cross @ np.linalg.solve(shared, np.swapaxes(cross, -1, -2))
        return _position_sigma(information, seen.sum(axis=1) >= 3.0)


def _position_sigma(information: FloatArray, enough: npt.NDArray[np.bool_]) -> FloatArray:
    """Root of the trace (c,) of the position part of inverse information (c, 3, 3)."""
    sigma = np.full(len(information), np.inf)
    # The heading is eliminated first: what remains is 2 x 2.
    turn = np.maximum(information[:, 2, 2], 1e-12)
    arm = information[:, :2, 2]
    plane = information[:, :2, :2] - arm[:, :, None] * arm[:, None] / turn[:, None, None]
    det = plane[:, 0, 0] * plane[:, 1, 1] - plane[:, 0, 1] * plane[:, 1, 0]
    good = enough & (plane[:, 0, 0] > 0.0) & (plane[:, 1, 1] > 0.0)
    good &= det > 1e-9 * plane[:, 0, 0] * plane[:, 1, 1]
    sigma[good] = np.sqrt((plane[good, 0, 0] + plane[good, 1, 1]) / det[good])
    return sigma
