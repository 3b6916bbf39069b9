"""What pyproject.toml cannot say: experiments and their configurations are installed inside the package.

In a checkout they are folders of their own; in an installation ``python -m torchreg.experiments`` runs them.
"""

from pathlib import Path

from setuptools import find_packages, setup

EXPERIMENTS = "torchreg.experiments"
_TASKS = [path.name for path in Path("configs").iterdir() if path.is_dir()]
FOLDERS = {"": "configs"} | {f".{name}": f"configs/{name}" for name in _TASKS}
CONFIGS = {f"{EXPERIMENTS}.configs{name}": folder for name, folder in FOLDERS.items()}

setup(
    packages=[
        *find_packages(include=["torchreg*"]),
        *(f"torchreg.{name}" for name in find_packages(include=["experiments*"])),
        *CONFIGS,
    ],
    package_dir={EXPERIMENTS: "experiments", **CONFIGS},
    package_data={
        # Weights of networks lie beside the modules that read them.
        "torchreg": ["py.typed", "*.pyi", "**/*.json", "**/*.safetensors"],
        EXPERIMENTS: ["report/*.j2", "papers/*.j2"],
        **{name: ["*.yaml"] for name in CONFIGS},
    },
)
