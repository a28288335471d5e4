"""What `landmark-nav demo` is made of, without ROS: processes, path, story."""
