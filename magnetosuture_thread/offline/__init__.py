"""A recorded experiment through the same tracker and model as in the graph, without one."""
