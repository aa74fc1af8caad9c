"""Contacts from joint angles: what the heights of contacts and the readings tell of the robot."""
