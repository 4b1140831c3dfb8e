"""Scripted experts, and the recorder that turns their demonstrations into LeRobotDatasets."""
