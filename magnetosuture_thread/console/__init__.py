"""The operator's page: what it needs of a running graph, who may steer and for how long, and the server."""
