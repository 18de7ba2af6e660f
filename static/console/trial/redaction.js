// Removes from the page whatever reveals the policy while the station is redacted for this user.

/** Take every [data-reveals] off the page while snapshots say "veiled", and put it back afterwards. */
export function applyRedaction(store) {
  const taken = []; // [comment node in its place, the element]
  const draw = () => {
    const veiled = Boolean(store.snapshot?.veiled);
    document.body.toggleAttribute("data-veiled", veiled);
    if (!veiled) {
      for (const [mark, element] of taken.splice(0)) mark.replaceWith(element);
      return;
    }
    for (const element of document.querySelectorAll("[data-reveals]")) {
      const mark = document.createComment("");
      element.replaceWith(mark);
      taken.push([mark, element]);
    }
  };
  store.on("snapshot", draw);
  document.body.addEventListener("htmx:afterSettle", draw);
}
