// Copies the text beside a button, also if the browser offers the clipboard only to pages over HTTPS.

import { t } from "../site/sentences.js";

const SAID_MS = 2000;

async function copy(area) {
  if (navigator.clipboard) {
    try {
      await navigator.clipboard.writeText(area.value);
      return true;
    } catch {
      // not allowed: continue as without a clipboard
    }
  }
  area.focus();
  area.select();
  return document.execCommand("copy");
}

for (const button of document.querySelectorAll("[data-copy]")) {
  const words = button.textContent;
  button.addEventListener("click", async () => {
    const done = await copy(button.closest("details").querySelector("textarea"));
    button.textContent = done ? t("page.cite.copied", "Copied") : t("page.cite.selected", "Selected: copy it with the keyboard");
    setTimeout(() => (button.textContent = words), SAID_MS);
  });
}
