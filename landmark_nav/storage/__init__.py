"""Reading and writing of files: room, robot, maps, bags."""
