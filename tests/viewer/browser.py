"""Headless Chromium, driven by its own protocol: what a page shows, says and asks for."""

import asyncio
import base64
import json
import re
import shutil
import subprocess

from tornado.websocket import websocket_connect

PROGRAM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
MISSING = "headless Chromium is not installed; install the package chromium to run the tests of pages"


class Browser:
    """A page in a browser without a screen; close it."""

    def __init__(self, folder):
        self._loop = asyncio.new_event_loop()
        self._process = subprocess.Popen(
            [
                *(PROGRAM, "--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-port=0"),
                *(f"--user-data-dir={folder}", "--no-first-run", "--force-prefers-reduced-motion"),
                "about:blank",
            ],
            stderr=subprocess.PIPE,
            text=True,
        )
        for line in self._process.stderr:
            if found := re.search(r"ws://([^/]+)/", line):
                break
        self.said, self.asked, self._number = [], [], 0
        self._connection = self._run(self._open(found[1]))
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def _run(self, work):
        return self._loop.run_until_complete(asyncio.wait_for(work, 60))

    async def _open(self, host):
        from tornado.httpclient import AsyncHTTPClient

        pages = json.loads((await AsyncHTTPClient().fetch(f"http://{host}/json")).body)
        address = next(page["webSocketDebuggerUrl"] for page in pages if page["type"] == "page")
        return await websocket_connect(address, max_message_size=1 << 28)

    def call(self, method, **parameters):
        """Call the protocol and return its answer; events are kept on the way."""
        return self._run(self._call(method, parameters))

    async def _call(self, method, parameters):
        self._number += 1
        mine = self._number
        await self._connection.write_message(json.dumps({"id": mine, "method": method, "params": parameters}))
        while True:
            message = json.loads(await self._connection.read_message())
            if message.get("id") == mine:
                assert "error" not in message, message
                return message["result"]
            self._note(message.get("method"), message.get("params", {}))

    def _note(self, event, about):
        if event == "Log.entryAdded" and about["entry"]["level"] == "error":
            self.said.append(about["entry"]["text"])
        elif event == "Runtime.exceptionThrown":
            self.said.append(about["exceptionDetails"]["text"])
        elif event == "Runtime.consoleAPICalled" and about["type"] == "error":
            self.said.append(str(about["args"]))
        elif event == "Network.requestWillBeSent":
            self.asked.append(about["request"]["url"])

    def open(self, file, width=1400, height=900):
        """Open a file in a window of this size and wait until it is drawn."""
        self.said.clear()
        self.asked.clear()
        self.resize(width, height)
        self.call("Page.navigate", url=file.as_uri())
        self.wait("document.readyState === 'complete'")

    def resize(self, width, height=900):
        """Give the window another size."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def ask(self, code):
        """Return what an expression of the page is worth."""
        found = self.call("Runtime.evaluate", expression=code, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait(self, code):
        """Wait until an expression is true."""
        for _ in range(200):
            if self.ask(code):
                return
            self._run(asyncio.sleep(0.05))
        raise AssertionError(f"never true: {code}; the page said {self.said}")

    def press(self, key):
        """Press a key where the focus is."""
        for kind in ("keyDown", "keyUp"):
            self.call("Input.dispatchKeyEvent", type=kind, key=key, code=key)

    def picture(self):
        """Return the window as PNG."""
        return base64.b64decode(self.call("Page.captureScreenshot")["data"])

    def close(self):
        """End the browser."""
        self._loop.call_soon(self._connection.close)  # which asks for the loop that runs
        self._run(asyncio.sleep(0))
        self._process.terminate()
        self._process.wait(10)
        self._loop.close()
