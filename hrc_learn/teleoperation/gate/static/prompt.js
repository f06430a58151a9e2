// Lets a drag be followed promptly where drawing takes its time. Runs before viser's client.
(() => {
  "use strict";
  const INTERVAL = 45; // from one frame to the next request: three of a screen with 60 a second [ms]

  // Browsers tell of a pointer's motion once a frame: what drags is told to viser's client as
  // it moves.
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

  // Smooth edges would cost half of the frames, and nobody reads the picture back.
  const getContext = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, wishes) {
    return getContext.call(this, kind, { ...wishes, antialias: false, preserveDrawingBuffer: false });
  };

  // Frames drawn one right after the other leave no time to hear of the pointer in between.
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
