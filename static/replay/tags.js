// The tags of an episode: each is a link to the episodes that have it; a field adds one, a button removes one.

import { post, RequestFailed } from "../site/api.js";
import { t } from "../site/sentences.js";

const place = document.querySelector("[data-tags]");

if (place?.dataset.tags) {
  const form = place.querySelector("form");
  const said = place.querySelector("[role=status]");

  const change = async (content) => {
    try {
      const { tags } = await post(place.dataset.tags, content);
      draw(tags);
      said.textContent = "";
      return true;
    } catch (error) {
      if (!(error instanceof RequestFailed)) throw error;
      said.textContent = error.message;
      return false;
    }
  };

  const draw = (tags) => {
    const items = tags.map((words) => {
      const item = place.querySelector("template").content.firstElementChild.cloneNode(true);
      const [link, button] = item.children;
      link.textContent = words;
      link.href = `${place.dataset.list}?tag=${encodeURIComponent(words)}`;
      button.value = words;
      button.setAttribute("aria-label", t("page.tags.remove", "Remove the tag {words}", { words }));
      return item;
    });
    place.querySelector("ul").replaceChildren(...items);
  };

  place.querySelector("ul").addEventListener("click", async ({ target }) => {
    const button = target.closest("button");
    if (!button) return;
    await change({ remove: [button.value] });
    form.tag.focus();
  });
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    if (await change({ add: [form.tag.value] })) form.reset();
  });
  draw(JSON.parse(document.getElementById("tags").textContent));
}
