// The pages in frames follow the switch between light and dark. By themselves they follow the system only, and so they
// do in pages opened as files, where a browser keeps frames apart.
const system = window.matchMedia("(prefers-color-scheme: dark)");

function follow() {
  const chosen = document.body.dataset.theme;
  const wanted = chosen === "dark" || (chosen !== "light" && system.matches) ? "dark" : "light";
  for (const frame of document.querySelectorAll(".live iframe")) {
    const inner = frame.contentDocument;
    if (!inner || inner.documentElement.style.colorScheme === wanted) continue;
    const button = inner.getElementById("theme"); // of the report
    if (button) button.click();
    else inner.documentElement.style.colorScheme = wanted;
  }
}

for (const frame of document.querySelectorAll(".live iframe")) frame.addEventListener("load", follow);
new MutationObserver(follow).observe(document.body, { attributeFilter: ["data-theme"] });
system.addEventListener("change", follow);
