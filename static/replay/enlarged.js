// Which camera is shown large: none (all in a grid), or one with the others in a strip; the page's address keeps it.

const NAME = "camera";

/**
 * Let a press on a picture or name in `section` enlarge it, and a second press restore the grid; the key v steps through all.
 */
export function enlarged(section) {
  const figures = [...section.querySelectorAll(".replay-camera")];
  if (figures.length < 2) return;
  const names = figures.map((figure) => figure.querySelector("[data-enlarge]"));
  let large = names.findIndex((name) => name.dataset.enlarge === new URLSearchParams(window.location.search).get(NAME));
  section.style.setProperty("--others", String(figures.length - 1));

  const show = () => {
    section.toggleAttribute("data-focus", large >= 0);
    figures.forEach((figure, index) => figure.toggleAttribute("data-large", index === large));
    names.forEach((name, index) => name.setAttribute("aria-pressed", String(index === large)));
  };
  const choose = (index) => {
    large = index === large || index >= figures.length ? -1 : index;
    show();
    const address = new URL(window.location.href);
    if (large < 0) address.searchParams.delete(NAME);
    else address.searchParams.set(NAME, names[large].dataset.enlarge);
    window.history.replaceState(null, "", address);
  };
  figures.forEach((figure, index) => figure.addEventListener("click", () => choose(index)));
  document.addEventListener("keydown", (event) => {
    const typing = event.target.closest("select, textarea, input:not([type=range]), dialog");
    if (event.key !== "v" || typing || event.ctrlKey || event.metaKey || event.altKey || event.repeat) return;
    choose(large + 1);
  });
  show();
}
