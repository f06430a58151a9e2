"use strict";
// Shows the messages of the program in Rerun's viewer. Each message is a part of a recording.
(async () => {
  const words = document.getElementById("words");
  try {
    await wasm_bindgen({ module_or_path: fetch("/viewer/re_viewer_bg.wasm") });
    const viewer = new wasm_bindgen.WebHandle({ hide_welcome_screen: true, persist: false });
    await viewer.start(document.getElementById("view"));
    words.remove();
    viewer.open_channel("run", "hrc");
    const { url, protocols } = hrcDoor.socket("session");
    const socket = new WebSocket(url, protocols);
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (typeof data !== "string") viewer.send_rrd_to_channel("run", new Uint8Array(data));
    };
    // A page that is open when the run ends keeps its content.
    socket.onclose = () => viewer.close_channel("run");
  } catch (error) {
    words.textContent = `The viewer cannot be shown: ${error}`;
    throw error;
  }
})();
