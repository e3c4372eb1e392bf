"""Results as JSON on stdout: what was found, and beside it the decision and its findings."""

from __future__ import annotations

import json

from orthocal.assessment.comparison import Comparison
from orthocal.assessment.findings.calibration import decide
from orthocal.assessment.findings.comparison import decide_comparison
from orthocal.assessment.findings.decision import Decision
from orthocal.assessment.findings.validation import decide_validation
from orthocal.assessment.validation import Validation
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.file import calibration_document


def printed_calibration(calibration: Calibration) -> str:
    """A calibration as in calibration.json, with `decision` and `findings`, which follow from it.

    It loads as a calibration, too; what follows is then found anew.
    """
    document = {**calibration_document(calibration), **decide(calibration).to_document()}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def printed_decision(decision: Decision) -> str:
    """A decision and its findings."""
    return json.dumps(decision.to_document(), indent=1, allow_nan=False) + "\n"


def printed_comparison(comparison: Comparison) -> str:
    """A comparison with its `decision` and `findings`."""
    document = {**json.loads(comparison.to_json()), **decide_comparison(comparison).to_document()}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def printed_validation(validation: Validation) -> str:
    """A validation with its `decision` and `findings`."""
    document = {**json.loads(validation.to_json()), **decide_validation(validation).to_document()}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
