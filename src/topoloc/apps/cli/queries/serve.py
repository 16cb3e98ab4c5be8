"""topoloc serve MAP|FOLDER|ATLAS ..."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import AtlasConfig, LocalizerConfig, MissingExtraError, TrackerConfig
from topoloc.apps.cli.features_option import QUERY_FEATURES
from topoloc.apps.cli.output import File, Flag, UsageError, catch_stop_signals
from topoloc.apps.cli.queries.served_maps import ServedMaps, read_token
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option
from topoloc.apps.cluster.config import ReplicasConfig
from topoloc.apps.service.config import ServiceConfig

_LOOPBACK = ("127.0.0.1", "localhost", "::1")


@dataclass(frozen=True)
class Command:
    """What `topoloc serve` takes."""

    maps: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="MAP|FOLDER|ATLAS ...", help_behavior_hint="(required)"),
    ] = ()
    """Map files, folders, and atlases (s3://bucket/campus, too). A map goes by the name of its file
    without .topo, a tile by its id."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Where to listen. Elsewhere than on this machine only with a token, and with TLS or a proxy
    that speaks it."""
    port: Annotated[int, tyro.conf.arg(metavar="N")] = 8571
    """Port; 0 takes a free one, which is printed."""
    token_file: File = None
    """A file whose text every client must show as its bearer token."""
    tls_cert: File = None
    """Certificate chain (PEM)."""
    tls_key: File = None
    """Its private key (PEM)."""
    behind_proxy: Flag = False
    """A proxy in front of the service speaks TLS with the clients."""
    features: QUERY_FEATURES = None
    """Which of the maps' features are asked; of several, the next where the one before leaves the
    pose unclear."""
    memory_mb: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 512)")
    ] = None
    """Megabytes of maps that are kept in memory; the maps used longest ago are closed first."""
    workers: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one a processor)")
    ] = None
    """Pictures that are localized at a time."""
    max_queue: Annotated[
        int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 32)")
    ] = None
    """Requests that may wait for a worker; one more is told to come again later."""
    ray: Annotated[
        str | None,
        tyro.conf.arg(metavar="HOST:PORT|auto|local", help_behavior_hint="(default: none)"),
    ] = None
    """A Ray cluster whose machines answer, by Ray Serve: `auto` is the one that runs on this
    machine, `local` one of this machine alone."""
    replicas: Annotated[
        str | None, tyro.conf.arg(metavar="N|LEAST-MOST", help_behavior_hint="(default: 1)")
    ] = None
    """With --ray, processes that answer; of LEAST-MOST as many as are needed."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config serve` prints it."""

    def run(self) -> int:
        if not self.maps:
            raise UsageError("serve takes at least one map, folder of maps or atlas")
        self._check_access()
        if self.ray is None and self.replicas is not None:
            raise UsageError("--replicas belongs to --ray")
        settings = read_settings(self.config)
        config = settings.of(ServiceConfig)
        for name in ("memory_mb", "workers", "max_queue"):
            config = with_option(config, name, getattr(self, name), f"--{name.replace('_', '-')}")
        read_token(self.token_file)
        try:
            from topoloc.apps.service.server import Address, serve
        except ModuleNotFoundError as error:
            raise MissingExtraError(
                f"a service needs {error.name}: pip install 'topoloc[serve]'"
            ) from error
        if self.ray is not None:
            return self._run_on_ray(settings, config)
        cert, key = (None if path is None else Path(path) for path in (self.tls_cert, self.tls_key))
        app = self._serve(settings, config).application()
        serve(app, Address(self.host, self.port, cert, key, self.behind_proxy), config)
        return 0

    def _run_on_ray(self, settings: Settings, config: ServiceConfig) -> int:
        from topoloc.apps.service.ray_serve import ProxyOptions, serve_on_ray

        assert self.ray is not None
        if self.port == 0:
            raise UsageError("--ray listens on the same port of all machines: --port 0 names none")
        replicas = self._parse_replicas(settings.of(ReplicasConfig))
        config = replace(config, workers=config.workers or replicas.cpus_per_replica)
        served = self._serve(settings, config)
        front = ProxyOptions(
            self.host,
            self.port,
            config.num_workers,
            config.max_queue,
            _absolute_path(self.tls_cert),
            _absolute_path(self.tls_key),
        )
        serve_on_ray(served, self.ray, front, replicas, _wait_for_signal)
        return 0

    def _serve(self, settings: Settings, config: ServiceConfig) -> ServedMaps:
        return ServedMaps(
            tuple(path if self.ray is None else str(_absolute_path(path)) for path in self.maps),
            self.features,
            _absolute_path(self.token_file),
            self.host in _LOOPBACK and not self.behind_proxy,
            config,
            settings.of(LocalizerConfig),
            settings.of(TrackerConfig),
            settings.of(AtlasConfig),
        )

    def _parse_replicas(self, config: ReplicasConfig) -> ReplicasConfig:
        if self.replicas is None:
            return config
        least, dash, most = self.replicas.partition("-")
        if not least.isdecimal() or (dash and not most.isdecimal()):
            raise UsageError(f"--replicas is a number, or LEAST-MOST, not {self.replicas[:40]}")
        config = with_option(config, "least", int(least), "--replicas")
        config = with_option(config, "most", int(most or least), "--replicas")
        if config.most < config.least:
            raise UsageError(f"--replicas {self.replicas[:40]}: more at least than at most")
        return config

    def _check_access(self) -> None:
        """Nobody else's machine is answered without a token, and never in the clear."""
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UsageError("--tls-cert and --tls-key go together")
        is_private = self.host in _LOOPBACK and not self.behind_proxy
        if not is_private and self.token_file is None:
            raise UsageError(
                f"--host {self.host} is reached from elsewhere: --token-file FILE is needed"
            )
        if self.host not in _LOOPBACK and self.tls_cert is None and not self.behind_proxy:
            raise UsageError(
                f"--host {self.host} is reached from elsewhere: --tls-cert and --tls-key, or"
                " --behind-proxy, are needed"
            )


def _wait_for_signal() -> None:
    with catch_stop_signals() as stop:
        stop.wait()


def _absolute_path(path: str | None) -> str | None:
    """The path as other processes find it, too."""
    return path if path is None or "://" in path else str(Path(path).absolute())
