"""All nodes that learn and localize, in one process with one executor."""

from __future__ import annotations

from functools import partial

from landmark_nav.nodes.landmark_learner import LandmarkLearnerNode
from landmark_nav.nodes.odometry_fusion import OdometryFusionNode
from landmark_nav.nodes.panorama_synthesizer import PanoramaSynthesizerNode
from landmark_nav.nodes.sweep_capture import SweepCaptureNode
from landmark_nav.nodes.triangulation_localizer import TriangulationLocalizerNode
from landmark_nav.nodes.triplet_selector import TripletSelectorNode
from landmark_nav.ros.run import run_node

_NODES = (
    SweepCaptureNode,
    PanoramaSynthesizerNode,
    LandmarkLearnerNode,
    TripletSelectorNode,
    TriangulationLocalizerNode,
    OdometryFusionNode,
)
# Sum of the threads of the nodes as separate processes.
main = partial(run_node, *_NODES, threads=3 + 2 + 3 + 1 + 1 + 1)

if __name__ == '__main__':
    raise SystemExit(main())
