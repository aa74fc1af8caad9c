"""Contacts from joint angles: what the heights of contacts and the readings show of the robot."""
