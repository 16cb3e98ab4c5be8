"""Run the service on Ray Serve: replicas of one application behind Serve's own proxies."""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from topoloc import ClusterError, MissingExtraError
from topoloc.apps.cluster.config import ReplicasConfig
from topoloc.apps.cluster.connection import LOCAL, connect_to_cluster
from topoloc.apps.service.access_middleware import App
from topoloc.apps.service.logs import log

NAME = "topoloc"


@runtime_checkable
class ApplicationFactory(Protocol):
    """Creates the application in each replica. It may be pickled."""

    def application(self) -> App:
        """Create the application. Raises TopolocError."""
        ...


@dataclass(frozen=True)
class ProxyOptions:
    """Address of Serve's proxies, and the requests that a replica runs and queues."""

    host: str
    port: int
    num_answered: int
    num_waiting: int
    tls_cert: str | None = None
    tls_key: str | None = None

    def http_options(self) -> dict[str, Any]:
        """Return the options of Serve's proxies."""
        tls = {"ssl_certfile": self.tls_cert, "ssl_keyfile": self.tls_key} if self.tls_cert else {}
        return {"host": self.host, "port": self.port} | tls


class Replica:
    """One process that serves the application."""

    def __init__(self, maker: ApplicationFactory) -> None:
        self._maker = maker

    def __serve_build_asgi_app__(self) -> App:
        return self._maker.application()


def serve_on_ray(
    maker: ApplicationFactory,
    address: str,
    proxy: ProxyOptions,
    replicas: ReplicasConfig,
    wait: Callable[[], None],
) -> None:
    """Serve on a cluster until `wait` returns, then finish the requests in progress. Raises
    MissingExtraError: Ray Serve is not installed; ClusterError: no cluster answers, or no replica
    can start. The text gives the reason.

    Args:
        address: cluster, as for `connect_to_cluster`.
        wait: called when the service runs.
    """
    with connect_to_cluster(address):
        with MissingExtraError.on_import("replicas need Ray Serve ({})", "cluster"):
            from ray import serve
        logging.getLogger("ray.serve").setLevel(logging.ERROR)
        is_running = bool(serve.status().proxies)
        try:
            try:
                if not is_running:
                    serve.start(proxy_location="EveryNode", http_options=proxy.http_options())
                deployment = _create_deployment(serve, proxy, replicas).bind(maker)
                serve.run(deployment, name=NAME, route_prefix="/")
            except Exception as error:  # of many classes; the deployment's state holds the text
                raise ClusterError(
                    f"no replica of the service began: {_failure_reason(serve, error)}"
                ) from error
            shown = f"{'https' if proxy.tls_cert else 'http'}://{proxy.host}:{proxy.port}"
            shown = "the proxies of Ray Serve that run already" if is_running else shown
            print(f"topoloc serves on {shown} by Ray", file=sys.stderr, flush=True)
            wait()
        finally:
            _shut_down(serve, is_ours=not is_running and address != LOCAL)


def _create_deployment(serve: Any, proxy: ProxyOptions, replicas: ReplicasConfig) -> Any:
    scaling: dict[str, Any] = {"num_replicas": replicas.least}
    if replicas.most > replicas.least:
        scaling = {
            "autoscaling_config": {
                "min_replicas": replicas.least,
                "max_replicas": replicas.most,
                "target_ongoing_requests": max(replicas.busy * proxy.num_answered, 0.1),
                "upscale_delay_s": replicas.upscale_delay_s,
                "downscale_delay_s": replicas.downscale_delay_s,
            }
        }
    return serve.deployment(
        name=NAME,
        max_ongoing_requests=proxy.num_answered + proxy.num_waiting,
        ray_actor_options={"num_cpus": replicas.cpus_per_replica},
        **scaling,
    )(serve.ingress()(Replica))


def _shut_down(serve: Any, is_ours: bool) -> None:
    """Delete the application, and end Serve if this process started it and nothing else runs."""
    try:
        serve.delete(NAME)
        if is_ours and not serve.status().applications:
            serve.shutdown()
    except Exception as error:  # the cluster is gone already
        log("serve not ended", logging.WARNING, error)


def _failure_reason(serve: Any, error: Exception) -> str:
    """Return the line of the deployment's message with a topoloc error, else the last line."""
    text = str(error)
    with suppress(Exception):  # without a status the error itself is used
        deployments = serve.status().applications[NAME].deployments.values()
        text = "\n".join(one.message for one in deployments if one.message) or text
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    known = [line.partition(": ")[2] for line in lines if line.startswith("topoloc.errors.")]
    return (known or lines[-1:] or [type(error).__name__])[-1][:400]
