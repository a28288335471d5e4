"""What is wrong with a recording: its streams against each other and against its images."""

from landmark_nav.diagnosis.doctor import Delays, diagnose, Diagnosis, QUICK, THOROUGH
from landmark_nav.diagnosis.findings import Finding, table, worst

__all__ = [
    'QUICK',
    'THOROUGH',
    'Delays',
    'Diagnosis',
    'Finding',
    'diagnose',
    'table',
    'worst',
]
