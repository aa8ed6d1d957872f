"""The command line `litho-design`."""

from litho_data.foundation.faces import require_extra


def main() -> None:
    """Run it; one line and exit code 2 where its extra is not installed."""
    require_extra("litho-design", "design")
    from litho_design.cli.app import main as run

    run()
