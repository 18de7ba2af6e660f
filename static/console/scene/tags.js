// Short sentences in the corner of a pane about what is drawn in it.

export class Tags {
  #list = document.createElement("ul");
  #tags = new Map();

  /** Append a list of class `name` to `element`. */
  constructor(element, name) {
    this.#list.className = `tags stack ${name}`;
    element.append(this.#list);
  }

  /** Show `words` under that name, with a patch of `colour` if given; without words, remove the entry. */
  show(name, words, colour = "") {
    let tag = this.#tags.get(name);
    if (!words) {
      tag?.remove();
      this.#tags.delete(name);
      return;
    }
    if (!tag) {
      tag = document.createElement("li");
      tag.dataset.tag = name;
      if (colour) {
        const patch = document.createElement("i");
        patch.style.setProperty("--colour", colour);
        tag.append(patch);
      }
      tag.append(document.createElement("span"));
      this.#tags.set(name, tag);
      this.#list.append(tag);
    }
    if (tag.lastElementChild.textContent !== words) tag.lastElementChild.textContent = words;
  }
}
