"""Files: room, robot, maps, bags."""
