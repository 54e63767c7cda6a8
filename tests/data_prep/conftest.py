"""The embedded body, which garments and motions are made for."""

import pytest

from clothjax.files import storage


@pytest.fixture(scope="session")
def body():
    return storage.load_body("body")


@pytest.fixture(scope="session")
def names():
    return storage.joint_names("body")
