"""Simulation of a random room, a camera and a robot."""
