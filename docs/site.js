// The theme puts tables into boxes that scroll and buttons beside code after a page has loaded:
// boxes become reachable by keyboard, and each group of buttons has a name of its own.
function makeAccessible() {
  for (const box of document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])")) {
    box.tabIndex = 0
    box.setAttribute("role", "region")
    box.setAttribute("aria-label", `Table ${tables++}`)
  }
  for (const nav of document.querySelectorAll(".md-code__nav:not([aria-label])")) {
    nav.setAttribute("aria-label", `Code ${codes++}`)
  }
}

let tables = 1
let codes = 1
makeAccessible()
new MutationObserver(makeAccessible).observe(document.documentElement, { childList: true, subtree: true })
