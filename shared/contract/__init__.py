"""What every process agrees on: topics, messages, who may say what, and the names of classes and processes."""
