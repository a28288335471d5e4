"""Facades: flat vertical surfaces found in panoramas, and the room that they enclose."""
