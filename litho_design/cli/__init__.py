"""The command line `litho-design`."""

from litho_data.foundation.faces import require_extra


def main() -> None:
    """Run the command line. If the package extra for it is not installed, print one line and exit with code
    2.
    """
    require_extra("litho-design", "design")
    from litho_design.cli.app import main as run

    run()
