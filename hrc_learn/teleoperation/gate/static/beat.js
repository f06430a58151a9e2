// Holds the socket of the session apart from the page, whose own thread may be busy drawing.
"use strict";
let socket, alive = Date.now();
const BEAT = 40; // period [ms]: after three missed beats, no motion is requested of the arm

self.onmessage = ({ data }) => {
  if (data.alive) alive = Date.now();
  else if (data.send && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(data.send));
  else if (data.open) {
    socket = new WebSocket(data.open.url, data.open.protocols);
    socket.onmessage = (event) => self.postMessage(JSON.parse(event.data));
    socket.onclose = (event) => self.postMessage({ type: "closed", words: event.reason });
  }
};
setInterval(() => {
  if (socket?.readyState !== WebSocket.OPEN) return;
  socket.send(JSON.stringify({ type: "beat", lag: Math.max(0, Date.now() - alive) / 1000 }));
}, BEAT);
