// Makes the arm follow a drag promptly even if drawing is slow. Runs before viser's client.
(() => {
  "use strict";
  const INTERVAL = 45; // time from one frame to the next request [ms]: three frames at 60 Hz

  // Browsers report a pointer's motion once per frame. Here, the motion of a dragging pointer is
  // passed to viser's client immediately.
  addEventListener("pointerrawupdate", (event) => {
    if (event.buttons) dispatchEvent(new PointerEvent("pointermove", event));
  });

  const drawsInSoftware = () => {
    const gl = document.createElement("canvas").getContext("webgl2");
    const named = gl?.getExtension("WEBGL_debug_renderer_info");
    const renderer = named ? gl.getParameter(named.UNMASKED_RENDERER_WEBGL) : "";
    gl?.getExtension("WEBGL_lose_context")?.loseContext();
    return /swiftshader|llvmpipe|softpipe|basic render/i.test(renderer);
  };
  if (!drawsInSoftware()) return;

  // Antialiasing would halve the frame rate, and no program reads the picture back.
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, wishes) {
    return getContext.call(this, kind, { ...wishes, antialias: false, preserveDrawingBuffer: false });
  };

  // Frames drawn immediately after each other leave no time for the events of the pointer.
  const request = window.requestAnimationFrame.bind(window);
  const asked = new Map();
  let count = 0, waiting = false, next = 0;
  const draw = (time) => {
    waiting = false;
    next = performance.now() + INTERVAL;
    const callbacks = [...asked.values()];
    asked.clear();
    for (const callback of callbacks) callback(time);
  };
  window.requestAnimationFrame = (callback) => {
    asked.set(++count, callback);
    if (!waiting) {
      waiting = true;
      setTimeout(() => request(draw), Math.max(0, next - performance.now()));
    }
    return count;
  };
  window.cancelAnimationFrame = (number) => asked.delete(number);
})();
