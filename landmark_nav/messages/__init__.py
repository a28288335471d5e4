"""Standard messages <-> the types of `landmark_nav.types`, with and without ROS."""
