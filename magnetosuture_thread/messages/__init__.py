"""Messages of the graph for rclpy and rosbags alike: built, packed as CDR bytes, and read."""
