// A picture that is shown smaller than it is opens in its full size over the page: by a click, a tap, or Enter or
// space while it has the focus. Escape, another click or the button closes it, and the focus returns to the picture.
const dialog = document.createElement("dialog");
dialog.className = "enlarged";
dialog.ariaLabel = "The picture in its full size";
dialog.innerHTML = '<button type="button">Close (Esc)</button><img alt="">';
dialog.addEventListener("click", () => dialog.close());
document.body.append(dialog);

function open(picture) {
  const shown = dialog.querySelector("img");
  shown.src = picture.currentSrc;
  shown.alt = picture.alt;
  shown.width = picture.naturalWidth;
  dialog.showModal();
  dialog.scrollTo(0, 0);
}

// Whether a picture is shown smaller than it is depends on the width of the window.
function mark(picture) {
  const smaller = picture.clientWidth > 0 && picture.naturalWidth > 1.1 * picture.clientWidth;
  const attributes = { role: "button", tabindex: "0", title: "Show the full size (click or Enter)" };
  picture.classList.toggle("enlarges", smaller);
  for (const [name, value] of Object.entries(attributes))
    smaller ? picture.setAttribute(name, value) : picture.removeAttribute(name);
}

for (const picture of document.querySelectorAll("article img")) {
  if (picture.closest("a")) continue;
  new ResizeObserver(() => mark(picture)).observe(picture);
  picture.addEventListener("load", () => mark(picture));
  picture.addEventListener("click", () => picture.classList.contains("enlarges") && open(picture));
  picture.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault();
    open(picture);
  });
}
