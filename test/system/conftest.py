"""Fixtures that start nodes, for this folder."""

from ros_fixtures import client, domain_id, setup_files, start, supervisor

__all__ = ['client', 'domain_id', 'setup_files', 'start', 'supervisor']
