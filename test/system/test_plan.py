"""`landmark-nav plan` as a user calls it."""

from builders import walls_of
import cv2
import numpy as np
import pytest
import yaml

from landmark_nav.cli.main import main
from landmark_nav.geometry.walls import Paper, Room
from landmark_nav.planning.views import is_free
from landmark_nav.simulation.setup_documents import robot_document, room_document
from landmark_nav.simulation.world import DEFAULT_MOUNT
from landmark_nav.storage.setup_files import load_room


@pytest.fixture
def folder(tmp_path):
    """Room and robot of a user."""
    walls = walls_of([(0, 0), (5, 0), (5, 4), (0, 4)], 'senw', 2.6)
    papers = tuple(
        Paper(color, (x, 0.0, 1.6), 0.21, 0.297)
        for color, x in (('red', 1.4), ('green', 2.6), ('blue', 3.7))
    )
    (tmp_path / 'room.yaml').write_text(room_document(Room(walls, papers)))
    (tmp_path / 'robot.yaml').write_text(robot_document(DEFAULT_MOUNT))
    return tmp_path


def plan(folder, *options, out='new/plan.yaml'):
    return main(
        [
            'plan', '--room', str(folder / 'room.yaml'), '--robot', str(folder / 'robot.yaml'),
            '--positions', '2', '--out', str(folder / out), *options,
        ]
    )  # fmt: skip


def test_a_plan_is_written_and_drawn(folder, capsys):
    assert plan(folder) == 0
    text = (folder / 'new' / 'plan.yaml').read_text()
    document = yaml.safe_load(text)
    poses = np.array([place['pose'] for place in document['positions']])
    assert poses.shape == (2, 3)
    assert is_free(load_room(folder / 'room.yaml'), 0.399, poses[:, :2]).all()
    predicted, compared = document['predicted'], document['compared']
    mean = predicted['localization']['mean_m']
    assert 0.0 < mean < compared['random']['best_m'] <= compared['random']['median_m']
    assert predicted['landmarks'] >= 3
    assert predicted['localization']['median_m'] <= predicted['localization']['p95_m']
    camera_image = cv2.imread(str(folder / 'new' / 'plan.png'))
    assert camera_image.shape[1] > camera_image.shape[0] > 300
    printed = capsys.readouterr().out
    assert 'times the error of the plan' in printed

    drawn = (folder / 'new' / 'plan.png').read_bytes()
    assert plan(folder) == 1
    assert 'plan.yaml: is there already: add --overwrite' in capsys.readouterr().err
    assert plan(folder, '--overwrite') == 0
    assert (folder / 'new' / 'plan.yaml').read_text() == text
    assert (folder / 'new' / 'plan.png').read_bytes() == drawn


@pytest.mark.parametrize(
    ('options', 'out', 'status', 'message'),
    [
        (('--clearance', '2.4'), 'new/plan.yaml', 1, 'too small for this clearance'),
        (('--focal', '5000'), 'new/plan.yaml', 1, 'see all 3 papers'),
        (('--room', 'nowhere.yaml'), 'new/plan.yaml', 1, 'nowhere.yaml: cannot be read: No such'),
        ((), 'room.yaml/plan.yaml', 1, 'room.yaml: is a file'),
        ((), 'plan.png', 2, 'take plan.yaml'),
        (('--focal', '-3'), 'new/plan.yaml', 2, '--focal'),
    ],
)
def test_what_can_not_be_planned_is_reported_in_a_line(
    options, out, status, message, folder, capsys
):
    assert plan(folder, *options, out=out) == status
    assert message in capsys.readouterr().err.splitlines()[-1]
    assert not (folder / 'new').exists()
