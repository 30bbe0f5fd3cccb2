"""The verb ``serve-surrogate``; its documentation is that of ``taccorl.robot_plugin.surrogate_server``."""

from taccorl.cli.parse import parse


def main(argv: list[str]) -> int:
    """Run ``taccorl serve-surrogate`` with the words ``argv`` after it; returns the exit status 0."""
    from taccorl.robot_plugin.surrogate_server import ServeConfig, serve

    return serve(parse(ServeConfig, argv, prog="taccorl serve-surrogate"))
