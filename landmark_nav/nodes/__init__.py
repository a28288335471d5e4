"""The ROS nodes, one module an executable."""
