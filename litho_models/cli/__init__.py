"""The command line `litho-models`."""

from litho_data.foundation.faces import require_extra


def main() -> None:
    """Run it; one line and exit code 2 where its extra is not installed."""
    require_extra("litho-models", "models")
    from litho_models.cli.app import main as run

    run()
