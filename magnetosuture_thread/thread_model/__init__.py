"""What the node `thread_model` runs: its settings, and prediction and estimate of a stream of poses."""
