"""Interfaces between processes: topics, messages, access rights, and the names of classes and processes."""
