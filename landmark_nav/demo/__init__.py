"""What `landmark-nav demo` is made of, without ROS: the room, the processes, the story."""
