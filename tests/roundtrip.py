"""What is saved as data comes back as it was."""

import json

from koopmpc.base.values import from_data as from_data
from koopmpc.base.values import to_data as to_data


def returned(value):
    """Return `value` as a file brings it back: from one JSON text, and the same with its arrays beside the text."""
    arrays = {}
    beside = from_data(json.loads(json.dumps(to_data(value, arrays))), arrays)
    again = from_data(json.loads(json.dumps(to_data(value))))
    assert again == beside, "the arrays beside the text came back as others than those in it"
    return again
