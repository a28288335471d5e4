"""
ROS messages <-> types, without ROS.

`decode` takes any object with the fields of the message: what rosbags deserialises and what rclpy
delivers alike. `encode` builds messages through a `MessageFactory`.
"""
