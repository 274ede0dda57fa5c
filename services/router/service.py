"""Wires nothing: a node in router mode passes on what the others say."""

from __future__ import annotations

import argparse

from shared.service import Node

NAME = "router"
MODE = "router"


def arguments(parser: argparse.ArgumentParser) -> None:
    """No flags of its own: `--listen` says where."""


def start(node: Node, options: argparse.Namespace) -> None:
    """Nothing: the session itself is the router."""
