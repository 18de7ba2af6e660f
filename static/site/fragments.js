// Fragments that the server renders: swapped in only if they differ from its previous answer, so that no cursor jumps and
// nothing flickers.

const rendered = new Map(); // element -> HTML that the server last rendered into it

function normal(html) {
  const template = document.createElement("template");
  template.innerHTML = html;
  return template.innerHTML.trim();
}

/** Make htmx skip swaps that change nothing. Call this before any module changes what the server rendered. */
export function quietFragments() {
  for (const element of document.querySelectorAll("[hx-get]:not(select)")) rendered.set(element, normal(element.innerHTML));
  document.body.addEventListener("htmx:beforeSwap", (event) => {
    const { target, serverResponse, xhr, shouldSwap } = event.detail;
    if (xhr.responseURL.includes("/login/")) {
      event.detail.shouldSwap = false; // the session has ended: show the login page, not its form inside this page
      window.location.reload();
      return;
    }
    const html = normal(serverResponse);
    if (rendered.get(target) === html) event.detail.shouldSwap = false;
    else if (shouldSwap) rendered.set(target, html);
  });
}
