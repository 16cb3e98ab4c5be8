"""topoloc serve MAP|FOLDER|ATLAS ..."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from topoloc import (
    AtlasConfig,
    Localizer,
    LocalizerConfig,
    MapCache,
    TopolocError,
    TrackerConfig,
    set_num_threads,
    warm_up,
)
from topoloc.apps.cli.features_option import QUERY_FEATURES, open_localizer
from topoloc.apps.cli.output import (
    File,
    Flag,
    RayOption,
    UsageError,
    catch_stop_signals,
    option,
    print_warning,
)
from topoloc.apps.cli.settings_file import Settings, read_settings, with_option
from topoloc.apps.cluster.config import ReplicasConfig
from topoloc.apps.service.config import ServiceConfig
from topoloc.apps.service.cross_origin import ANY_ORIGIN, parse_origin

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
MIN_TOKEN_LENGTH = 16


@dataclass(frozen=True)
class ServedMaps:
    """The maps of a service and the settings of their queries. Another process can serve the same.
    The token is read from its file, so that it is stored nowhere else."""

    paths: tuple[str, ...]
    features: str | None
    token_file: str | None
    loopback_only: bool
    service: ServiceConfig
    localizer: LocalizerConfig
    tracker: TrackerConfig
    atlas: AtlasConfig
    origins: tuple[str, ...]

    def application(self):  # no return type: the service is an extra, and loaded here alone
        """Return the application. It opens maps at their first request. Raises TopolocError."""
        from topoloc.apps.service.application import create_application

        access = read_token(self.token_file), self.loopback_only
        configs = self.tracker, self.atlas, self.origins
        return create_application(self._open_maps(), self.service, *access, *configs)

    def _open_maps(self) -> MapCache[Localizer]:
        """Return a cache of the maps, after the kernels are compiled."""
        from topoloc.apps.service.tile_fetcher import TileFetcher

        warm_up(
            only_if_cold=lambda: print("compiling, once, a minute ...", file=sys.stderr, flush=True)
        )
        if self.service.num_workers > 1:
            set_num_threads(1)
        maps = MapCache.with_memory(
            self.paths,
            lambda topomap: open_localizer(topomap, self.localizer, self.features),
            self.service.memory_mb,
            TileFetcher(self.service.fetch_s).path,
        )
        if not maps.names():
            print_warning(f"{', '.join(self.paths)}: no map yet; copy a .topo file there")
        return maps


def read_token(path: str | None) -> str | None:
    """Read the token from a file. Raises TopolocError: it has no usable token."""
    if path is None:
        return None
    try:
        token = Path(path).read_text(encoding="utf-8").strip()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "no text"
        raise TopolocError(f"cannot read the token in {path}: {reason}") from None
    is_long, is_one_word = len(token) >= MIN_TOKEN_LENGTH, " " not in token
    if not (is_long and is_one_word and token.isascii() and token.isprintable()):
        raise TopolocError(
            f"{path}: a token has at least {MIN_TOKEN_LENGTH} letters, digits or signs, and no"
            " spaces"
        )
    return token


@dataclass(frozen=True)
class Command:
    """Arguments of `topoloc serve`."""

    maps: Annotated[
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="MAP|FOLDER|ATLAS ...", help_behavior_hint="(required)"),
    ] = ()
    """Map files, folders, and atlases (s3://bucket/campus, too). A map goes by the name of its file
    without .topo, a tile by its id."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Address to listen on. If other machines reach it, a token is needed, and TLS or a proxy with
    TLS."""
    port: Annotated[int, tyro.conf.arg(metavar="N")] = 8571
    """Port. 0 takes a free one, which is printed."""
    token_file: File = None
    """File with the bearer token that every client must send."""
    tls_cert: File = None
    """Certificate chain (PEM)."""
    tls_key: File = None
    """Its private key (PEM)."""
    behind_proxy: Flag = False
    """A proxy in front of the service speaks TLS with the clients."""
    allow_origin: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], option("URL", "pages of the service only")
    ] = ()
    """Origin whose pages may ask, as https://app.example; repeat it for more. `*`, any page, needs
    --token-file."""
    lan: Flag = False
    """For phones in this network: listen on its addresses, make a certificate and a token for this
    run, and print the link and its QR code."""
    features: QUERY_FEATURES = None
    memory_mb: Annotated[int | None, option("N", "512")] = None
    """Megabytes of maps in memory. The least recently used map is closed first."""
    workers: Annotated[int | None, option("N", "one a processor")] = None
    """Images that are localized in parallel."""
    max_queue: Annotated[int | None, option("N", "32")] = None
    """Requests that may wait for a worker. Further ones are refused for the moment."""
    ray: RayOption = None
    """Ray cluster whose machines answer, by Ray Serve: `auto` is the one on this machine, `local` a
    temporary one."""
    replicas: Annotated[str | None, option("N|LEAST-MOST", "1")] = None
    """With --ray, the number of processes. LEAST-MOST adapts it to the load."""
    config: File = None
    """TOML file with all other settings, as printed by `topoloc config serve`."""

    def run(self) -> int:
        if not self.maps:
            raise UsageError("serve takes at least one map, folder of maps or atlas")
        if not self.lan:
            return self._run()
        from topoloc.apps.service import lan

        if self.ray is not None or self.behind_proxy:
            raise UsageError("--lan is for one process that speaks TLS: no --ray, --behind-proxy")
        self._check_pair()
        host = "0.0.0.0" if self.host in _LOOPBACK else self.host
        addresses = lan.find_lan_addresses(host)
        with lan.create_lan_files(addresses) as made:
            token_file = self.token_file or made.token
            cert, key = self.tls_cert or made.tls_cert, self.tls_key or made.tls_key
            command = replace(self, host=host, token_file=token_file, tls_cert=cert, tls_key=key)
            return command._run(lambda port: lan.print_links(addresses, port, token_file))

    def _run(self, on_ready: Callable[[int], None] = lambda _: None) -> int:
        self._check_access()
        if self.ray is None and self.replicas is not None:
            raise UsageError("--replicas belongs to --ray")
        settings = read_settings(self.config)
        config = settings.get(ServiceConfig)
        for name in ("memory_mb", "workers", "max_queue"):
            config = with_option(config, name, getattr(self, name), f"--{name.replace('_', '-')}")
        read_token(self.token_file)
        from topoloc.apps.service.application import Address, serve

        if self.ray is not None:
            return self._run_on_ray(self.ray, settings, config)
        cert, key = (None if path is None else Path(path) for path in (self.tls_cert, self.tls_key))
        app = self._serve(settings, config).application()
        serve(app, Address(self.host, self.port, cert, key, self.behind_proxy, on_ready), config)
        return 0

    def _run_on_ray(self, ray: str, settings: Settings, config: ServiceConfig) -> int:
        from topoloc.apps.service.ray_serve import ProxyOptions, serve_on_ray

        if self.port == 0:
            raise UsageError("--ray listens on the same port of all machines: --port 0 names none")
        replicas = self._parse_replicas(settings.get(ReplicasConfig))
        config = replace(config, workers=config.workers or replicas.cpus_per_replica)
        jobs = (config.num_workers, config.max_queue)
        tls = map(_absolute_path, (self.tls_cert, self.tls_key))
        proxy = ProxyOptions(self.host, self.port, *jobs, *tls)
        serve_on_ray(self._serve(settings, config), ray, proxy, replicas, _wait_for_signal)
        return 0

    def _serve(self, settings: Settings, config: ServiceConfig) -> ServedMaps:
        paths = tuple(one if self.ray is None else str(_absolute_path(one)) for one in self.maps)
        is_private = self.host in _LOOPBACK and not self.behind_proxy
        access = (_absolute_path(self.token_file), is_private)
        configs = (
            settings.get(LocalizerConfig),
            settings.get(TrackerConfig),
            settings.get(AtlasConfig),
        )
        return ServedMaps(paths, self.features, *access, config, *configs, self._origins())

    def _origins(self) -> tuple[str, ...]:
        """Return the allowed origins, checked."""
        try:
            return tuple(parse_origin(one) for one in self.allow_origin)
        except ValueError as error:
            raise UsageError(f"--allow-origin {error}") from None

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

    def _check_pair(self) -> None:
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UsageError("--tls-cert and --tls-key go together")

    def _check_access(self) -> None:
        """Refuse other machines without a token, or without TLS."""
        self._check_pair()
        if ANY_ORIGIN in self._origins() and self.token_file is None:
            raise UsageError("--allow-origin *: any page could ask: --token-file FILE is needed")
        is_private = self.host in _LOOPBACK and not self.behind_proxy
        if not is_private and self.token_file is None:
            raise UsageError(
                f"--host {self.host} is reached from elsewhere: --token-file FILE (or --lan) is"
                " needed"
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
    """Return the path for processes with another working folder."""
    return path if path is None or "://" in path else str(Path(path).absolute())
