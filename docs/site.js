// The theme puts tables into boxes that scroll and buttons beside code after a page has loaded:
// boxes and wide code become reachable by keyboard, each group of buttons has a name of its own,
// and the empty corner of a table is no header.
function makeAccessible() {
  for (const box of document.querySelectorAll(".md-typeset__scrollwrap:not([tabindex])")) {
    box.tabIndex = 0
    box.setAttribute("role", "region")
    box.setAttribute("aria-label", `Table ${tables++}`)
  }
  for (const corner of document.querySelectorAll("th:empty")) {
    corner.replaceWith(document.createElement("td"))
  }
  for (const nav of document.querySelectorAll(".md-code__nav:not([aria-label])")) {
    nav.setAttribute("aria-label", `Code ${codes++}`)
  }
}

// Code scrolls where the window is narrow, and needs no stop of the keyboard elsewhere.
function reachWideCode() {
  for (const code of document.querySelectorAll("pre > code")) {
    if (code.scrollWidth > code.clientWidth) code.tabIndex = 0
  }
}

let tables = 1
let codes = 1
makeAccessible()
addEventListener("load", reachWideCode)
addEventListener("resize", reachWideCode)
new MutationObserver(makeAccessible).observe(document.documentElement, { childList: true, subtree: true })
