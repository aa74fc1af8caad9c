"""Bags of ROS 1, ROS 2 in SQLite, and MCAP: with an index by rosbags, else record by record."""
