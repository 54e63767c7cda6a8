import json
import shutil
import subprocess

import pytest

VALIDATE = """
import { readFileSync } from "fs";
import validator from "gltf-validator";
const found = await validator.validateBytes(new Uint8Array(readFileSync(process.argv[2])));
console.log(JSON.stringify(found.issues));
"""


@pytest.fixture(scope="session")
def khronos(tmp_path_factory):
    """A function from a file to what Khronos's validator of glTF finds in it."""
    if shutil.which("npm") is None:
        pytest.skip("needs Node")
    folder = tmp_path_factory.mktemp("khronos")
    subprocess.run(["npm", "install", "--silent", "gltf-validator"], check=True, cwd=folder)
    (folder / "validate.mjs").write_text(VALIDATE)

    def issues(path):
        command = ["node", "validate.mjs", str(path)]
        return json.loads(subprocess.run(command, check=True, cwd=folder, capture_output=True, text=True).stdout)

    return issues
