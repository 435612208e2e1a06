"""The node `console`: the operator page of a running graph."""
