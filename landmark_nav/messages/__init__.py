"""
ROS messages <-> types, without ROS.

`decode` accepts any object with the fields of the message, from rosbags or from rclpy. `encode`
builds messages through a `MessageFactory`.
"""
