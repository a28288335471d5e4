"""The demo as a user starts it: it succeeds, ends all processes, and reports one that died."""

import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from harness import SETUPS
import pytest

from landmark_nav.demo.scenario import RECORDED_TOPICS
from landmark_nav.storage.bags import Bag
from landmark_nav.storage.bags.definitions import TOPIC_TYPES
from landmark_nav.storage.maps import load_map

NODES = 7
# The protection level comes of the joint estimator alone.
SHOWN = {
    topic: TOPIC_TYPES[topic]
    for topic in RECORDED_TOPICS
    if topic not in ('/diagnostics', 'odometry_fusion/protection_level')
}
DEMO = [sys.executable, '-m', 'landmark_nav', 'demo', '--out']
# The same with fewer frames of fewer pixels, fewer candidates and a shorter way.
SHORT_DEMO = """
import functools, pathlib, sys
from landmark_nav.cli import demo, main
from landmark_nav.demo import scenario
scenario._TOUR_M = 3.0
demo.node_commands = functools.partial(
    demo.node_commands, parameter_file=pathlib.Path(sys.argv.pop(1))
)
sys.exit(main.main())
"""
SHORT = f"""/**:
  ros__parameters:
    camera_file: {SETUPS / 'camera_quarter_vga.yaml'}
    capture: {{frames: 16, step_rad: 0.3926991}}
    attention: {{candidates: 60}}
"""


@pytest.fixture
def demo(tmp_path, domain_id):
    """A demo under way, in the domain of its environment."""
    process = subprocess.Popen(
        [*DEMO, str(tmp_path / 'demo')], env={**os.environ, 'ROS_DOMAIN_ID': str(domain_id)},
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        # What a shell starts in its background ignores the signal, and so would this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    yield process
    process.kill()


def processes(folder):
    """Node -> id of the processes that were given files in `folder`."""
    found = {}
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            words = (entry / 'cmdline').read_text().split('\0')
        except OSError:
            continue
        if '--ros-args' in words and any(str(folder) in node for node in words):
            found[words[2].rpartition('.')[2]] = int(entry.name)
    return found


def wait(condition, timeout_s):
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, 'waited too long'
        time.sleep(0.1)


def test_a_node_that_died_is_reported_and_the_others_end(demo, tmp_path):
    wait(lambda: len(processes(tmp_path)) == NODES, 60.0)
    os.kill(processes(tmp_path)['triplet_selector'], signal.SIGKILL)
    _, complaint = demo.communicate(timeout=30)
    assert demo.returncode == 1
    assert 'triplet_selector ended with signal SIGKILL' in complaint
    assert len(complaint.strip().splitlines()) == 1
    assert processes(tmp_path) == {}


def test_learns_drives_and_stays_exact(tmp_path, domain_id):
    folder, parameters = tmp_path / 'demo', tmp_path / 'short.yaml'
    parameters.write_text(SHORT)
    command = [sys.executable, '-c', SHORT_DEMO, str(parameters), 'demo', '--out', str(folder)]
    environment = {**os.environ, 'ROS_DOMAIN_ID': str(domain_id)}
    done = subprocess.run(command, capture_output=True, text=True, timeout=540, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    assert len(load_map(folder / 'map').landmarks) >= 20
    bag = Bag(folder / 'recording')
    assert bag.complete
    assert bag.counts['/odometry/fused'] > 500
    assert (folder / 'foxglove.json').is_file()
    # What the layouts of Foxglove and RViz show, as the nodes publish it.
    assert {name: bag.types.get(f'/{name}') for name in SHOWN} == SHOWN
    static, *_ = bag.messages(['/tf_static'])
    (camera,) = static.message.transforms
    parents = {camera.child_frame_id: camera.header.frame_id} | {
        one.child_frame_id: one.header.frame_id
        for entry in bag.messages(['/tf'])
        for one in entry.message.transforms
    }
    frame = 'camera_optical_frame'
    while frame in parents:
        frame = parents.pop(frame)
    assert frame == 'map'
    assert not parents
    measured = json.loads((folder / 'demo.json').read_text())
    assert measured['fused']['position_rmse_m'] < measured['odometry']['position_rmse_m']
    assert measured['nees']['interval_95'] is None
    page = (folder / 'report.html').read_text()
    data = json.loads(page.partition('id="data">')[2].partition('</script>')[0])
    assert len(data['panoramas']) == 2
    assert len(data['images']) > 50
    assert len(page) < 15e6
    assert processes(tmp_path) == {}
