"""What the bus carries, in MCAP files (https://mcap.dev): written so that a kill costs at most the last moments, read also where
the end is missing.

A file holds the topics twice: as they are on the bus (MessagePack, under their keys), which is what a replay takes, and in the
schemas of Foxglove (Protobuf), which Foxglove and Rerun show. A camera's frames are kept as JPEG alone, unless all bytes are
wanted.
"""
