"""A seeded room, its camera and its robot."""
