// Connects the page to the program: signs of life, control of the arm, and messages. It also
// names the controls that viser's client leaves without a name.
//
// Runs before viser's client. A worker sends the signs of life, even while the page draws. Each
// sign of life contains the time for which the page itself has not responded.
(() => {
  "use strict";
  const client = hrcDoor.draw();

  // viser's client reads from the address which socket to open.
  const address = new URL(location.href);
  address.searchParams.set("websocket", hrcDoor.socket("view", client).url);
  history.replaceState(null, "", address);

  const worker = new Worker("/static/beat.js");
  worker.postMessage({ open: hrcDoor.socket("session", client) });
  const send = (message) => worker.postMessage({ send: message });
  setInterval(() => worker.postMessage({ alive: true }), 50);

  let role = "", ended = false;
  const bar = document.createElement("div");
  const words = document.createElement("span");
  const button = document.createElement("button");
  bar.id = "session";
  bar.setAttribute("role", "status");
  bar.append(words, button);
  const style = document.createElement("link");
  style.rel = "stylesheet";
  style.href = "/static/session.css";
  document.head.append(style);
  addEventListener("DOMContentLoaded", () => document.body.append(bar));

  const show = (text, action, wish) => {
    words.textContent = text;
    button.hidden = !action;
    button.textContent = action ?? "";
    button.onclick = () => send({ type: "lead", wish });
    bar.hidden = !text;
  };

  const state = ({ status }) => {
    if (!status) return;
    role = status.role;
    bar.className = role;
    if (role === "watches") {
      if (!status.may_lead) show("You are watching: this link is for watching only.");
      else if (status.asked) show("You are watching. You have asked to lead; the answer may take ten seconds.");
      else if (status.taken) show("You are watching: another person leads.", "Ask to lead", "ask");
      else show("Nobody leads.", "Lead", "ask");
    } else if (status.asked) {
      show("Another person asks to lead.", "Hand over", "hand_over");
    } else {
      bar.className = status.words ? "warns" : "leads";
      show(status.words);
    }
  };

  const over = (text) => {
    ended = true;
    bar.className = "over";
    document.getElementById("root").inert = true;
    show(text);
  };

  // For screen readers: the label of a row names its inputs and sliders.
  const name = (element, text) => {
    if (!element.getAttribute("aria-label")) element.setAttribute("aria-label", text);
  };
  const nameControls = () => {
    for (const label of document.querySelectorAll("#root p > label")) {
      const row = label.closest("[class*=Flex-root]");
      const controls = row?.querySelectorAll("input:not([type=hidden]), [role=slider]") ?? [];
      for (const control of controls) name(control, label.textContent);
    }
    const icons = document.querySelectorAll("#root [class*=ActionIcon-root]");
    icons.forEach((icon, i) => name(icon, i % 2 ? "Settings of the view" : "Commands"));
    for (const close of document.querySelectorAll("[class*=Notification-closeButton]")) {
      name(close, "Close");
    }
    // In viser's settings: the address it has connected to, its logo, and nodes of the scene.
    for (const input of document.querySelectorAll("#root input[value^=ws]")) name(input, "Server");
    for (const image of document.querySelectorAll("#root img:not([alt])")) image.alt = "";
    for (const dialog of document.querySelectorAll("[role=dialog]")) name(dialog, "Commands");
    for (const opener of document.querySelectorAll("#root div[aria-haspopup=dialog]")) {
      opener.setAttribute("role", "button");
      name(opener, "Properties");
    }
    document.getElementById("root").setAttribute("role", "main");
  };
  addEventListener("DOMContentLoaded", () => setInterval(nameControls, 500));

  // On a device that supports AR, the arm can be shown in the room.
  const offerRoom = async () => {
    const able = await navigator.xr?.isSessionSupported("immersive-ar").catch(() => false);
    if (!able || !(await fetch("/xr")).ok) return;
    const link = document.createElement("a");
    link.id = "room";
    link.href = "/xr";
    link.textContent = "In AR";
    document.body.append(link);
  };
  addEventListener("DOMContentLoaded", offerRoom);

  worker.onmessage = ({ data }) => {
    if (data.type === "state") state(data);
    else if (data.type === "end") over(data.words);
    else if (data.type === "closed" && !ended) {
      over(data.words || "The program does not answer any more. Reload the page to connect again.");
    }
  };
})();
