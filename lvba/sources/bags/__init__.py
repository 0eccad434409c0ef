"""Bags of ROS: containers (ros1, mcap, sqlite) -> messages (layout, by their definitions) -> records (decoders)."""
