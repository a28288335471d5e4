"""Parts of `landmark-nav demo` that do not need ROS: room, processes, scenario, report."""
