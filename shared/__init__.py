"""Code that all processes share: topics, messages, bus, cell description, geometry, service runtime."""
