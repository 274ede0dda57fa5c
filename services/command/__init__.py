"""The `penumbra` command: its entry point, and the commands that look at or steer a running cell."""


def main() -> int:
    """Run `penumbra` with the words of the command line; returns the exit code. The script of an installation calls this
    function, so that Ctrl-C during the imports ends the command without a traceback too."""
    try:
        from penumbra.services.command import cli

        return cli.main()
    except KeyboardInterrupt:
        return 130  # see cli.EXIT_CODES
