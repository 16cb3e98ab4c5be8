"""The service as a deployment of Ray Serve: replicas of the one application, on as many machines,
behind Serve's own proxies."""

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
    """Makes the application, in each replica; it may be pickled."""

    def application(self) -> App:
        """Raises TopolocError."""
        ...


@dataclass(frozen=True)
class ProxyOptions:
    """Where Serve's proxies listen, and how many requests a replica takes at once: those that it
    answers, and those that wait in it."""

    host: str
    port: int
    num_answered: int
    num_waiting: int
    tls_cert: str | None = None
    tls_key: str | None = None


class Replica:
    """One of those who answer."""

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
    """Serve on the cluster at `address` (as `connect_to_cluster` takes it) until `wait`, which is
    called then, returns; requests in progress are answered.

    Raises:
        MissingExtraError: Ray Serve is not installed.
        ClusterError: no cluster answers, or no replica can begin; its reason is told.
    """
    with connect_to_cluster(address):
        try:
            from ray import serve
        except ImportError as error:
            raise MissingExtraError(
                f"replicas need Ray Serve ({error}): pip install 'topoloc[cluster,serve]'"
            ) from error
        logging.getLogger("ray.serve").setLevel(logging.ERROR)
        was_there = bool(serve.status().proxies)
        options = {
            "host": proxy.host,
            "port": proxy.port,
            "ssl_certfile": proxy.tls_cert,
            "ssl_keyfile": proxy.tls_key,
        }
        try:
            try:
                if not was_there:
                    serve.start(
                        proxy_location="EveryNode",
                        http_options={
                            key: value for key, value in options.items() if value is not None
                        },
                    )
                serve.run(
                    _create_deployment(serve, proxy, replicas).bind(maker),
                    name=NAME,
                    route_prefix="/",
                )
            # of many classes; what a replica raised is a text in the deployment's state
            except Exception as error:
                raise ClusterError(
                    f"no replica of the service began: {_failure_reason(serve, error)}"
                ) from error
            where = f"{'https' if proxy.tls_cert else 'http'}://{proxy.host}:{proxy.port}"
            print(
                "topoloc serves on"
                f" {'the proxies of Ray Serve that run already' if was_there else where} by Ray",
                file=sys.stderr,
                flush=True,
            )
            wait()
        finally:
            _shut_down(serve, is_ours=not was_there and address != LOCAL)


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
    """Our application goes, and Serve with it where it is ours alone."""
    try:
        serve.delete(NAME)
        if is_ours and not serve.status().applications:
            serve.shutdown()
    except Exception as error:  # the cluster is gone already
        log("serve not ended", logging.WARNING, error)


def _failure_reason(serve: Any, error: Exception) -> str:
    """What Serve says of our deployment: of a traceback the line that names a known failure, else
    the last one."""
    text = str(error)
    with suppress(Exception):  # the error itself says enough then
        deployments = serve.status().applications[NAME].deployments.values()
        text = (
            "\n".join(deployment.message for deployment in deployments if deployment.message)
            or text
        )
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    known = [line.partition(": ")[2] for line in lines if line.startswith("topoloc.errors.")]
    return (known or lines[-1:] or [type(error).__name__])[-1][:400]
