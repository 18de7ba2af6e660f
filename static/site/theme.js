// Dark or light before anything is drawn: what the page asks for, unless this browser was told otherwise.
// A classic script, because modules run only after the first paint.
(() => {
  const root = document.documentElement;
  const key = `eva-theme-${root.dataset.theme}`; // bench and paper are remembered apart
  const chosen = localStorage.getItem(key);
  if (chosen === "dark" || chosen === "light") root.dataset.theme = chosen;
  document.addEventListener("click", (event) => {
    if (!event.target.closest("[data-theme-toggle]")) return;
    root.dataset.theme = root.dataset.theme === "dark" ? "light" : "dark";
    localStorage.setItem(key, root.dataset.theme);
    document.dispatchEvent(new Event("eva:theme"));
  });
})();
