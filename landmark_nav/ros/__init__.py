"""What the nodes share of rclpy."""
