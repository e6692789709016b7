"""A container engine for the tests: the one that answers, or one of our own that is gone afterwards; a base
image without a registry; and the platoon of `docker-compose.yml` on it.

What belongs to the machine (package mirror, certificates, proxies, pip's index) is asked of the machine.
"""

import contextlib
import json
import os
import shutil
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from tests.waiting import eventually

ROOT = Path(__file__).parents[2]
CERTIFICATES = Path("/etc/ssl/certs/ca-certificates.crt")
BASE = "maniple-test-base"
IMAGE = "maniple-test"
NEEDED = {"dockerd": "docker.io", "docker": "docker.io", "debootstrap": "debootstrap", "iptables": "iptables"}
"""Programs, and the Debian packages they come in."""
PROXIES = ("http_proxy", "https_proxy", "no_proxy", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY")


def missing() -> str:
    """What has to be installed before `engine` can start one; empty where nothing has."""
    packages = {package for program, package in NEEDED.items() if shutil.which(program) is None}
    return " ".join(sorted(packages))


def answers(environment: Mapping[str, str] = os.environ) -> bool:
    """Whether a container engine answers."""
    if shutil.which("docker") is None:
        return False
    command = ["docker", "version", "--format", "{{.Server.Version}}"]
    return subprocess.run(command, capture_output=True, env=environment, check=False).returncode == 0


@contextlib.contextmanager
def engine() -> Iterator[dict[str, str]]:
    """The environment in which `docker` finds an engine. One that is started for this is ended, and its
    images and containers with it."""
    if answers():
        yield dict(os.environ)
        return
    folder = Path(tempfile.mkdtemp(prefix="maniple-engine-"))
    socket = f"unix://{folder}/docker.sock"
    command = ["dockerd", "--data-root", folder / "data", "--exec-root", folder / "exec", "--host", socket]
    environment = {**os.environ, "DOCKER_HOST": socket}
    with (folder / "dockerd.log").open("w") as log:
        daemon = subprocess.Popen(
            [*map(str, command), "--pidfile", str(folder / "pid"), "--bridge", "none"],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    try:
        eventually(lambda: answers(environment) or daemon.poll() is not None, 60.0)
        assert daemon.poll() is None, (folder / "dockerd.log").read_text()[-3000:]
        yield environment
    finally:
        daemon.terminate()
        try:
            daemon.wait(60.0)
        except subprocess.TimeoutExpired:
            daemon.kill()
            daemon.wait()
        unmount(folder)
        shutil.rmtree(folder)


def unmount(folder: Path) -> None:
    """Take away what an engine that has ended leaves mounted."""
    points = [line.split()[1] for line in Path("/proc/mounts").read_text().splitlines()]
    for point in reversed(points):
        if Path(point).is_relative_to(folder):
            subprocess.run(["umount", "--lazy", point], check=False)


class Images:
    """Makes the images."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        self._environment = environment

    def make(self) -> str:
        """Build the image of this tree; returns its name."""
        arguments = {"BASE": self._base()}
        if arguments["BASE"] == BASE:
            arguments["PIP_CERT"] = str(CERTIFICATES)
        index = subprocess.run(
            ["python3", "-m", "pip", "config", "get", "global.index-url"], capture_output=True, text=True
        ).stdout.strip()
        if index.startswith("http"):
            arguments["PIP_INDEX_URL"] = index
        arguments |= {name: os.environ[name] for name in PROXIES if name in os.environ}
        options = [word for item in arguments.items() for word in ("--build-arg", "=".join(item))]
        self.docker(
            *("build", "--network", "host", "--tag", IMAGE, "--file", "deploy/Dockerfile", *options, "."),
            within_s=300.0,
        )
        return IMAGE

    def _base(self) -> str:
        """The default base image where it is here or can be had, otherwise Debian by debootstrap."""
        for name in (BASE, default_base()):
            if self.docker("image", "ls", "--quiet", name):
                return name
        try:
            self.docker("pull", default_base(), within_s=60.0)
        except (AssertionError, subprocess.TimeoutExpired):
            self._import_debian()
            return BASE
        return default_base()

    def _import_debian(self) -> None:
        mirror, codename = mirror_of_debian()
        with tempfile.TemporaryDirectory(prefix="maniple-base-") as folder:
            include = "--include=python3,python3-venv,ca-certificates"
            command = ["debootstrap", "--variant=minbase", include, codename, folder, mirror]
            told(command, within_s=300.0, environment={**os.environ, **apt_proxy()})
            shutil.copy(CERTIFICATES.resolve(), Path(folder, str(CERTIFICATES)[1:]))
            leave_out = ("./var/cache/apt", "./var/lib/apt/lists", "./usr/share/doc", "./usr/share/locale")
            tar = subprocess.Popen(
                ["tar", "-C", folder, *(f"--exclude={path}/*" for path in leave_out), "-c", "."],
                stdout=subprocess.PIPE,
            )
            with tar:
                self.docker("import", "-", BASE, within_s=120.0, stdin=tar.stdout)
            assert tar.returncode == 0

    def docker(self, *arguments: str, within_s: float = 30.0, stdin: Any = subprocess.DEVNULL) -> str:
        """`docker`; returns what it says."""
        return told(["docker", *arguments], within_s, self._environment, stdin)


def default_base() -> str:
    """What the Dockerfile is built on by default."""
    lines = (ROOT / "deploy" / "Dockerfile").read_text().splitlines()
    return next(line.removeprefix("ARG BASE=") for line in lines if line.startswith("ARG BASE="))


def mirror_of_debian() -> tuple[str, str]:
    """Where this machine gets Debian from, and which release."""
    words = ["--format", "$(ORIGIN) $(REPO_URI) $(CODENAME)", "Created-By: Packages"]
    for line in told(["apt-get", "indextargets", *words], 30.0).splitlines():
        origin, uri, codename = line.split()
        if origin == "Debian" and codename.isalpha():
            return uri, codename
    raise AssertionError("the machine's package sources name no Debian release")


def apt_proxy() -> dict[str, str]:
    """The proxy that apt uses here, as an environment."""
    said = told(["apt-config", "dump", "--format", "%v%n", "Acquire::http::Proxy"], 30.0).strip()
    return {"http_proxy": said} if said else {}


class Compose:
    """The platoon of `docker-compose.yml`, with names of its own."""

    def __init__(
        self, environment: Mapping[str, str], name: str, scene: Path, logs: Path, user: tuple[int, int]
    ) -> None:
        self.name = name
        self.scene = scene
        self.logs = logs
        self._images = Images(environment)
        self._said = scene.with_name("compose.txt")
        self._environment = {
            **environment,
            "PLATOON": name,
            "COMPOSE_PROJECT_NAME": name,
            "MANIPLE_IMAGE": IMAGE,
            "MANIPLE_SCENARIOS": str(scene.parent),
            "MANIPLE_SCENARIO": scene.name,
            "MANIPLE_USER": "{}:{}".format(*user),
            "LOGS": str(logs),
        }
        asked = subprocess.run(["docker", "compose", "version"], capture_output=True, check=False)
        self._command = ("docker-compose",) if asked.returncode else ("docker", "compose")
        self._up: subprocess.Popen[bytes] | None = None

    def up(self) -> None:
        """Start everything in the foreground, as a user does."""
        with self._said.open("wb") as file:
            self._up = subprocess.Popen(
                [*self._command, "up", "--no-build"],
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                cwd=ROOT,
                env=self._environment,
            )

    def ended(self, within_s: float) -> int:
        """The exit status of `up`, when it has come to its end."""
        assert self._up is not None
        return self._up.wait(within_s)

    def said(self) -> str:
        """What `up` has shown."""
        return self._said.read_text(errors="replace")

    def docker(self, *arguments: str) -> str:
        """`docker`, with `{}` for the platoon's name."""
        return self._images.docker(*(word.replace("{}", self.name) for word in arguments))

    def address(self, node: str) -> str:
        """Of a container on the fleet network."""
        found = json.loads(self.docker("inspect", f"{{}}-{node}"))
        return str(found[0]["NetworkSettings"]["Networks"][f"{self.name}-fleet"]["IPAddress"])

    def image(self) -> Any:
        """What the engine says of the image."""
        return json.loads(self.docker("image", "inspect", IMAGE))[0]

    def shell(self, *arguments: str) -> str:
        """A command in the shell container."""
        command = [*self._command, "run", "--rm", "-T", "shell", *arguments]
        return told(command, 60.0, self._environment)

    def states(self) -> dict[str, Any]:
        """What the engine says of every container, by node; those of `shell` come and go."""
        labels = (f"com.docker.compose.project={self.name}", "com.docker.compose.oneoff=False")
        filters = [word for label in labels for word in ("--filter", f"label={label}")]
        ids = self.docker("ps", "--all", "--quiet", *filters).split()
        found = json.loads(self.docker("inspect", *ids)) if ids else []
        return {one["Name"].removeprefix(f"/{self.name}-"): one["State"] for one in found}

    def down(self) -> None:
        """Remove what is left."""
        if self._up is not None and self._up.poll() is None:
            self._up.kill()
            self._up.wait()
        told([*self._command, "down", "--timeout", "2", "--remove-orphans"], 120.0, self._environment)


def told(
    command: list[str],
    within_s: float,
    environment: Mapping[str, str] = os.environ,
    stdin: Any = subprocess.DEVNULL,
) -> str:
    """What a command says.

    Raises:
        AssertionError: it failed; with what it said.
        TimeoutExpired: it took too long.
    """
    done = subprocess.run(
        command,
        stdin=stdin,
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment,
        timeout=within_s,
        check=False,
    )
    assert done.returncode == 0, f"{' '.join(command)}:\n{done.stderr[-3000:]}{done.stdout[-3000:]}"
    return done.stdout
