"""Sweeps located by the same papers have correlated errors."""

from dataclasses import replace

from hung_rooms import AS_EXPECTED, measurements_of, nees, panoramas_at, POSES, PRIOR, world_of
import numpy as np
import pytest
from scenes import rectangle_room

from landmark_nav.geometry.angles import wrap_rad
from landmark_nav.geometry.walls import Paper
from landmark_nav.learning.adjustment.solution import adjust
from landmark_nav.learning.reference_area.common_errors import joint_covariance, pose_errors
from landmark_nav.learning.reference_area.model import ReferenceAreaConfig

PAPERS = tuple(
    Paper(color, (x, 0.0, 1.4), 0.21, 0.297)
    for color, x in (('red', 1.8), ('green', 2.9), ('blue', 4.4))
)
ROOM = rectangle_room(6.0, 5.0, PAPERS)
CONFIG = ReferenceAreaConfig()
FOCAL_PX = 320.0


def given_by_papers(world, rng):
    """Poses (v, 4) with errors as papers make them, and covariances (v, 4, 4) of each alone."""
    covariance, by_papers = pose_errors(world.poses[:, :3], ROOM, CONFIG, FOCAL_PX)
    poses = world.poses.copy()
    factors = rng.normal(size=by_papers.shape[2])
    full = np.tile(np.diag([0.0, 0.0, PRIOR[2, 2], 0.0]), (len(poses), 1, 1))
    for k, (spread, part) in enumerate(zip(covariance, by_papers, strict=True)):
        full[k][np.ix_([0, 1, 3], [0, 1, 3])] = spread
        alone = rng.multivariate_normal(np.zeros(3), spread - part @ part.T)
        poses[k, [0, 1, 3]] += part @ factors + alone
    poses[:, 2] += np.sqrt(0.9) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]))
    poses[:, 2] += np.sqrt(0.1) * rng.normal(0.0, np.sqrt(PRIOR[2, 2]), len(poses))
    return poses, full


def test_what_sweeps_err_together_is_not_taken_for_agreement():
    rng = np.random.default_rng(3)
    of_poses, if_apart = [], []
    for _ in range(60):
        world = world_of(rng, 60)
        prior, covariance = given_by_papers(world, rng)
        panoramas = [
            replace(p, covariance=c, cylinder=replace(p.cylinder, fy=FOCAL_PX))
            for p, c in zip(panoramas_at(prior), covariance, strict=True)
        ]
        measurements = measurements_of(world, rng)
        for room, found in ((ROOM, of_poses), (replace(ROOM, papers=()), if_apart)):
            places = joint_covariance(panoramas, room, CONFIG)
            done = adjust(
                measurements, world.walls, world.points, panoramas, places, ROOM, AS_EXPECTED
            )
            error = done.poses - world.poses
            error[:, 3] = wrap_rad(error[:, 3])
            found.append(nees(error, done.pose_covariance).mean())
    # Four numbers each.
    assert 3.2 < np.mean(of_poses) < 4.8
    assert np.mean(of_poses) < np.mean(if_apart)


@pytest.mark.parametrize('papers', [(), PAPERS[:1], PAPERS[:2]])
def test_without_three_papers_only_the_height_is_shared(papers):
    places = joint_covariance(panoramas_at(POSES), replace(ROOM, papers=papers), CONFIG)
    apart = places[:4, 4:].copy()
    assert apart[2, 2] == pytest.approx(0.9 * PRIOR[2, 2], rel=1e-3)
    apart[2, 2] = 0.0
    assert not apart.any()
