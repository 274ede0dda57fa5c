"""Wires nothing: a node in router mode passes on what the others say."""

from __future__ import annotations

import argparse

from shared.service import Node

NAME = "router"
MODE = "router"


def arguments(parser: argparse.ArgumentParser) -> None:
    """No flags of its own: `--listen` says where."""


def start(node: Node, options: argparse.Namespace) -> None:
    """Says where it can be reached."""
    node.log.info("routing", listen=" ".join(node.connection.listen) or node.connection.where)
