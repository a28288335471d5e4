"""Bags: reading, writing, and conversion of their messages to types of this package."""

from landmark_nav.storage.bags.files import BagWriter
from landmark_nav.storage.bags.reader import Bag, BagMessage
from landmark_nav.storage.bags.sensors import sensor_events, SensorEvent
from landmark_nav.storage.bags.sweeps import read_sweep_folder, read_sweeps
