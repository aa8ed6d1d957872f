"""The command line `litho-models`."""

from litho_data.foundation.faces import require_extra


def main() -> None:
    """Run the command line.

    If the extra with the required packages is not installed, print one line and exit with code 2.
    """
    require_extra("litho-models", "models")
    from litho_models.cli.app import main as run

    run()
