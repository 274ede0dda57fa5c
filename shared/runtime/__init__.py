"""What a service runs on: the node, the bus and its readers, replicas, health, metrics and logs."""
