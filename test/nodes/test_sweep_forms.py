"""Sweeps reach the synthesizer raw or compressed, also one after the other."""

import numpy as np

from landmark_nav.geometry.camera import CameraModel, PanTiltMount
from landmark_nav.messages import encode
from landmark_nav.ros.topics import ros_factory
from landmark_nav.types import JointSample

CAMERA = CameraModel(64, 48, 60.0, 60.0, 31.5, 23.5)
NODE = 'panorama_synthesizer'


def test_a_sweep_may_come_in_another_form_than_the_last(start, client, setup_files, tmp_path):
    start(NODE, **setup_files)
    forms = {'sweep/image': encode.image, 'sweep/image/compressed': encode.compressed_image}
    images = {topic: client.advertise(topic) for topic in forms}
    info, trajectory = client.advertise('sweep/camera_info'), client.advertise('sweep/trajectory')
    publishers = [*images.values(), info, trajectory]
    client.wait(
        lambda: all(each.get_subscription_count() for each in publishers), 30.0, 'the synthesizer'
    )
    log = tmp_path / 'logs' / f'{NODE}.log'

    def reported(times):
        return lambda: log.read_text().count('no panorama') == times

    for number, topic in enumerate([*forms, 'sweep/image'], start=1):
        samples = [JointSample(1000 * number + k, 0.5 * k) for k in range(3)]
        for sample in samples:
            camera_image = np.full((48, 64), 100, np.uint8)
            images[topic].publish(
                forms[topic](ros_factory, camera_image, sample.stamp_ns, 'camera')
            )
            info.publish(encode.camera_info(ros_factory, CAMERA, sample.stamp_ns, 'camera'))
        trajectory.publish(encode.sweep_trajectory(ros_factory, samples, PanTiltMount()))
        client.wait(reported(number), 30.0, f'word of the sweep on {topic}')
    assert 'lacks all' not in log.read_text()
