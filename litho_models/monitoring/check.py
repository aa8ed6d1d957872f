"""The function behind ``litho-models check``, which tests whether a printer still behaves as its model
predicts.
"""

from collections.abc import Sequence
from pathlib import Path

from litho_data.commands.progress import say
from litho_data.foundation.begun import growing_folder
from litho_data.foundation.errors import InputError
from litho_data.foundation.run_facts import run_info
from litho_data.store import open_store
from litho_models.frozen.files import load_frozen
from litho_models.monitoring import wording
from litho_models.monitoring.inputs import gather
from litho_models.monitoring.judging import DEFAULT_RATE, judge
from litho_models.monitoring.prints import FIGURES, Check, CheckedModel
from litho_models.monitoring.report import write_check_report


def check(
    model: str | Path,
    store: str | Path,
    out: str | Path,
    *,
    reference: str | Path | None = None,
    new: Sequence[str] = (),
    false_alarms: float = DEFAULT_RATE,
    tolerance: float | None = None,
) -> Check:
    """Test whether a printer has changed. Every print is compared with the prediction of a model. The results
    for new prints are then compared with the results for reference prints. Write ``check.json``, a report and
    tables.

    Args:
        model: folder of a frozen model, or ``zoo:NAME``.
        store: dataset store of the new prints. If the model was trained on prints of this store, the locked
            scans of the store are left out.
        out: result folder.
        reference: store of prints that were made before any change of the printer. By default, the values of
            the training prints serve as reference. They are stored in the model's card.
        new: names of the new prints, if ``store`` also contains the reference prints. All other prints of the
            store are then reference prints.
        false_alarms: probability that an unchanged printer causes an alarm in at least one monitored
            quantity.
        tolerance: largest allowed relative drift of a monitored quantity (0.05 is 5 %); by default three
            times the spread of the quantity.

    Raises:
        InputError: the model or a store cannot be read, their pitch or level height differs, there are too
            few prints, or a rate or tolerance is out of range.
    """
    if not 0 < false_alarms < 0.5:
        raise InputError("rate of false alarms", got=false_alarms, wanted="a number between 0 and 0.5")
    if tolerance is not None and not 0 < tolerance < 1:
        raise InputError("tolerance", got=tolerance, wanted="a number between 0 and 1, such as 0.05 for 5 %")
    dataset = open_store(store)
    frozen = load_frozen(model)
    subject = {"dataset": {"name": dataset.name}, "model": {"name": frozen.name}}
    with growing_folder(out, Check.FILE_NAME, subject) as begun:
        say(f"checking {len(dataset)} scans of {dataset.name}")
        found = gather(frozen, dataset, reference, new)
        parameters = frozen.card["parameters"]
        # The error of the model on its training prints may be smaller than on unseen prints. In this case,
        # the errors on training prints and on new prints cannot be compared, so the error is not monitored.
        optimistic = wording.too_optimistic(found.reference, parameters)
        judged = judge(
            found.reference,
            found.new,
            rate=false_alarms,
            tolerance=tolerance,
            figures=[figure for figure in FIGURES if figure.name != "error" or not optimistic],
            between=found.between,
        )
        result = Check(
            run=run_info([], len(found.new), found.dropped),
            dataset=dataset.dataset_id,
            model=CheckedModel(name=frozen.name, sha256=frozen.sha256, dataset=frozen.card["dataset"]),
            reference=found.words,
            false_alarm_rate=false_alarms,
            alarm=any(one.alarm is not None for one in judged),
            verdict=wording.verdict(judged, false_alarms),
            figures=judged,
            reference_scans=found.reference,
            new_scans=found.new,
            notes=wording.notes(found.reference, found.new, judged, parameters),
        )
        write_check_report(result, begun.folder, between=found.between)
        result.write(begun.folder)
    return result
