// Holds the socket of the session apart from the page, whose own thread may be busy drawing.
"use strict";
let socket, alive = Date.now();
const BEAT = 40; // [ms]: three are missed before the arm is asked for no motion

self.onmessage = ({ data }) => {
  if (data.alive) alive = Date.now();
  else if (data.send && socket.readyState === WebSocket.OPEN) socket.send(JSON.stringify(data.send));
  else if (data.open) {
    socket = new WebSocket(data.open.url, data.open.protocols);
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      if (message.clock !== undefined) beat(message.clock);
      self.postMessage(message);
    };
    socket.onclose = (event) => self.postMessage({ type: "closed", words: event.reason });
  }
};
// With the clock of the server, it learns how long the way there and back takes.
const beat = (echo) => {
  if (socket?.readyState !== WebSocket.OPEN) return;
  const lag = Math.max(0, Date.now() - alive) / 1000;
  socket.send(JSON.stringify(echo === undefined ? { type: "beat", lag } : { type: "beat", lag, echo }));
};
setInterval(() => beat(), BEAT);
