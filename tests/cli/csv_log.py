"""A recording as a log in CSV, as robots have it."""

import numpy as np


def write_log(folder, recording, values, column):
    """A log in CSV whose readings are `values` (k,) in the column `column`."""
    folder.mkdir(exist_ok=True)
    contacts = np.column_stack([recording.time, 1e3 * recording.points, recording.force])
    head = "time,px_mm,py_mm,pz_mm,force"
    np.savetxt(folder / "contacts.csv", contacts, "%.9g", ",", header=head, comments="")
    time = recording.time[recording.reading_contact]
    readings = np.column_stack([time, recording.reading_taxel, values])
    head = f"time,taxel,{column}"
    np.savetxt(folder / "readings.csv", readings, "%.9g", ",", header=head, comments="")
    return folder
