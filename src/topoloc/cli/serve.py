"""topoloc serve MAP|FOLDER|ATLAS ..."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from topoloc.atlas.config import AtlasConfig
from topoloc.atlas.open_maps import Maps
from topoloc.cli.features_option import ASKED_FEATURES, localizer_of
from topoloc.cli.output import File, Flag, UsageError
from topoloc.cli.settings_file import Settings, read_settings, with_option
from topoloc.compiled import set_num_threads
from topoloc.errors import MissingExtraError, TopolocError
from topoloc.localization.localizer import LocalizerConfig
from topoloc.map.memory import set_node_memory
from topoloc.service.config import ServiceConfig
from topoloc.tracking.tracker import TrackerConfig
from topoloc.tracking.warm_up import is_warm, warm_up

_LOOPBACK = ("127.0.0.1", "localhost", "::1")
_LEAST_TOKEN = 16


@dataclass(frozen=True)
class Command:
    """What `topoloc serve` takes."""

    maps: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="MAP|FOLDER|ATLAS ...", help_behavior_hint="(required)")
    ] = ()
    """Map files, folders of them, and atlases. A map goes by the name of its file without .topo, a tile of an atlas by its id."""
    host: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = "127.0.0.1"
    """Where to listen. Elsewhere than on this machine only with a token, and with TLS or a proxy that speaks it."""
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
    features: ASKED_FEATURES = None
    """Which of the maps' features are asked; of several, the next where the one before leaves the pose unclear."""
    memory_mb: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 512)")] = None
    """Megabytes of maps that are kept in memory; the maps used longest ago are closed first."""
    workers: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: one a processor)")] = None
    """Pictures that are localized at a time."""
    max_queue: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: 32)")] = None
    """Requests that may wait for a worker; one more is told to come again later."""
    config: File = None
    """All other settings: a TOML file, as `topoloc config serve` prints it."""

    def run(self) -> int:
        if not self.maps:
            raise UsageError("serve takes at least one map, folder of maps or atlas")
        token = self._checked_token()
        settings = read_settings(self.config)
        config = settings.of(ServiceConfig)
        for name in ("memory_mb", "workers", "max_queue"):
            config = with_option(config, name, getattr(self, name), f"--{name.replace('_', '-')}")
        try:
            from topoloc.service.application import Access, make_application
            from topoloc.service.server import Address, serve
        except ModuleNotFoundError as error:
            raise MissingExtraError(f"a service needs {error.name}: pip install 'topoloc[serve]'") from error
        access = Access(token, loopback_only=self.host in _LOOPBACK and not self.behind_proxy)
        app = make_application(self._opened_maps(settings, config), config, access, settings.of(TrackerConfig), settings.of(AtlasConfig))
        cert, key = (None if path is None else Path(path) for path in (self.tls_cert, self.tls_key))
        serve(app, Address(self.host, self.port, cert, key, self.behind_proxy), config)
        return 0

    def _opened_maps(self, settings: Settings, config: ServiceConfig) -> Maps:
        """The maps, with half of the memory for nodes, and half for the rest of those that are open."""
        if not is_warm():
            print("compiling, once, a minute ...", file=sys.stderr, flush=True)
            warm_up()
        if config.num_workers > 1:
            set_num_threads(1)
        budget, localizer_config = config.memory_mb * 500_000, settings.of(LocalizerConfig)
        set_node_memory(budget)
        return Maps([Path(path) for path in self.maps], lambda topomap: localizer_of(topomap, localizer_config, self.features), budget)

    def _checked_token(self) -> str | None:
        """The token. Nobody else's machine is answered without one, and never in the clear."""
        if (self.tls_cert is None) != (self.tls_key is None):
            raise UsageError("--tls-cert and --tls-key go together")
        is_private = self.host in _LOOPBACK and not self.behind_proxy
        if not is_private and self.token_file is None:
            raise UsageError(f"--host {self.host} is reached from elsewhere: --token-file FILE is needed")
        if self.host not in _LOOPBACK and self.tls_cert is None and not self.behind_proxy:
            raise UsageError(f"--host {self.host} is reached from elsewhere: --tls-cert and --tls-key, or --behind-proxy, are needed")
        if self.token_file is None:
            return None
        try:
            token = Path(self.token_file).read_text(encoding="utf-8").strip()
        except (OSError, ValueError) as error:
            raise TopolocError(f"cannot read the token in {self.token_file}: {getattr(error, 'strerror', None) or 'no text'}") from None
        if len(token) < _LEAST_TOKEN or not token.isascii() or not token.isprintable() or " " in token:
            raise TopolocError(f"{self.token_file}: a token has at least {_LEAST_TOKEN} letters, digits or signs, and no spaces")
        return token
