"""The ground floor: what every process needs. Topics, messages, bus, cell description, geometry, service runtime."""
