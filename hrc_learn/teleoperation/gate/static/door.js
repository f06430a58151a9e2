// Keeps the secret of the address for this tab, and sends it to our own server only.
//
// The secret comes in the fragment of the address, which browsers send to no server. Session
// storage belongs to one origin, with its port, and to one tab.
(() => {
  "use strict";
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("secret", given);
    history.replaceState(null, "", location.pathname + location.search);
  }
  addEventListener("hashchange", () => location.reload());
  const secret = sessionStorage.getItem("secret") ?? "";

  const plain = window.fetch.bind(window);
  window.fetch = (resource, options) => {
    const request = new Request(resource, options);
    if (new URL(request.url).origin === location.origin) {
      request.headers.set("Authorization", `Bearer ${secret}`);
    }
    return plain(request);
  };

  const draw = () => {
    const bytes = crypto.getRandomValues(new Uint8Array(18));
    return btoa(String.fromCharCode(...bytes)).replaceAll("+", "-").replaceAll("/", "_");
  };
  const socket = (route, client = draw()) => {
    const origin = location.origin.replace(/^http/, "ws");
    return { url: `${origin}/${route}/${client}`, protocols: ["hrc", `secret.${secret}`] };
  };
  window.hrcDoor = { draw, socket };

  // If the secret is missing or outdated, show the reason instead of an empty page.
  plain("/admitted", { headers: { Authorization: `Bearer ${secret}` } }).then(async (answer) => {
    if (answer.ok) return;
    const words = document.createElement("p");
    words.style = "font: 20px system-ui, sans-serif; margin: 3em; text-align: center";
    words.textContent = await answer.text();
    document.body.replaceChildren(words);
  });
})();
