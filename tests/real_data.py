"""Real data that some tests are about; they are skipped where it is not there.

Skin files of the iCub (icub_skin), its URDF and meshes (icub_body), the links of a UR3e
(ur3e_meshes), standard pose graphs (g2o), touches of iCub's torso (icub_torso_touches) and NAO
touching itself (nao_selftouch), in the folder MESHSKIN_DATA, by default shared/data
beside the repository.
"""

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("MESHSKIN_DATA", Path(__file__).parents[1] / ".." / "shared" / "data"))
needs_skin = pytest.mark.skipif(not (DATA / "icub_skin").is_dir(), reason="no icub_skin in DATA")
needs_icub = pytest.mark.skipif(not (DATA / "icub_body").is_dir(), reason="no icub_body in DATA")
needs_ur3e = pytest.mark.skipif(
    not (DATA / "ur3e_meshes").is_dir(), reason="no ur3e_meshes in DATA"
)
needs_torso = pytest.mark.skipif(
    not (DATA / "icub_torso_touches").is_dir(), reason="no icub_torso_touches in DATA"
)
needs_nao = pytest.mark.skipif(
    not (DATA / "nao_selftouch").is_dir(), reason="no nao_selftouch in DATA"
)
needs_icub_log = pytest.mark.skipif(
    not (DATA / "icub_recording").is_dir(), reason="no icub_recording in DATA"
)
