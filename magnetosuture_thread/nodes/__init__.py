"""Nodes: the graph. The only room that knows ROS."""
