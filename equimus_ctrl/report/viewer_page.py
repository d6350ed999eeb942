"""MuJoCo's viewer as a page on one interface; imported only where that viewer is there.

The viewer binds all interfaces and has no setting for it (mujoco-studio 4.0). Its page is made here with another
address in the place of that one; a version that binds something else is refused before it listens.
"""

from collections.abc import Sequence
from typing import Any

from mujoco.studio import launch_thread, plugin, viewer_protocol, web_viewer

from equimus_ctrl.errors import NotAvailable

ALL = ("::", "0.0.0.0")


def launch_page(config: Any, plugins: Sequence[Any], address: str) -> Any:
    """Serve the page in a thread: what the viewer's own ``launch_web.launch`` does, on one interface.

    Args:
        config: the viewer's.
        plugins: of the viewer and of what it shows.
        address: of the interface.

    Returns:
        The handle of the viewer.
    """
    own = _page_on(address)
    of_viewer, of_sim = plugin.split_plugins(plugins)

    def target(endpoint: Any) -> None:
        viewer_protocol.run_viewer_loop(own(config, endpoint, plugins=of_viewer))

    return launch_thread.launch_thread(target, sim_plugins=of_sim)


def _page_on(address: str) -> Any:
    """The viewer's class with an address of its own.

    Raises:
        NotAvailable: where the viewer is another than the one that this is made for.
    """
    base = web_viewer.WebViewer
    if not hasattr(base, "_start_server"):
        raise NotAvailable(_other("it starts its server in another way"))

    class Page(base):  # type: ignore[misc,valid-type,unused-ignore]
        @property
        def _host(self) -> str:
            return address

        @_host.setter
        def _host(self, everywhere: str) -> None:
            """The viewer's own, which is not taken."""

        def _start_server(self) -> None:
            bound = self._http_sock.getsockname()[0]
            if bound != address and not {bound, address} <= set(ALL):
                self._http_sock.close()
                raise NotAvailable(_other(f"it binds {bound}"))
            super()._start_server()

    return Page


def _other(how: str) -> str:
    return f"this version of mujoco-studio cannot serve its page on one interface alone ({how}); expected 4.0"
