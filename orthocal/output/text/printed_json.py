"""Results as JSON on stdout, each with `decision` and `findings`."""

from __future__ import annotations

import json

from orthocal.assessment.assess import assessment_of
from orthocal.assessment.comparison import Comparison
from orthocal.assessment.validation import Validation
from orthocal.calibration.assessment_record import Assessment
from orthocal.calibration.calibration import Calibration
from orthocal.calibration.file import calibration_document


def printed_calibration(calibration: Calibration) -> str:
    """A calibration as in calibration.json, with `decision` and `findings` at the top level too.

    It loads as a calibration.
    """
    document = {
        **calibration_document(calibration),
        **assessment_of(calibration).to_document(),
    }
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def printed_assessment(found: Assessment) -> str:
    """A decision and its findings."""
    return json.dumps(found.to_document(), indent=1, allow_nan=False) + "\n"


def printed_comparison(comparison: Comparison) -> str:
    """A comparison with its decision and findings."""
    document = {**json.loads(comparison.to_json()), **comparison.assessment.to_document()}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"


def printed_validation(validation: Validation) -> str:
    """A validation with its decision and findings."""
    document = {**json.loads(validation.to_json()), **validation.assessment.to_document()}
    return json.dumps(document, indent=1, allow_nan=False) + "\n"
