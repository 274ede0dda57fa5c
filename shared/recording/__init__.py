"""Recordings of the bus in MCAP files (https://mcap.dev). If the recorder is killed, at most the last moments are lost, and files
without an end can be read.

A file contains the topics twice: as on the bus (MessagePack, under their keys), for replay, and in Foxglove's schemas (Protobuf),
for Foxglove and Rerun. A camera's frames are stored as JPEG only, unless their raw bytes are requested.
"""
