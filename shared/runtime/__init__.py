"""Runtime of the services: the node, the bus and its readers, replicas, health, metrics and logs."""
