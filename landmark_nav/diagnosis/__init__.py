"""Faults of a recording: its streams are compared with each other and with its images."""

from landmark_nav.diagnosis.doctor import check_papers, diagnose, QUICK
from landmark_nav.diagnosis.drives import THOROUGH
from landmark_nav.diagnosis.findings import Delays, Diagnosis, Finding, table
