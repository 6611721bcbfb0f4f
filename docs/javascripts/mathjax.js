// Typesets formulas with MathJax, fetched from its CDN, and only on pages that have any (pymdownx.arithmatex marks them).
// Without a network the TeX source stays readable.
document.addEventListener("DOMContentLoaded", () => {
  if (!document.querySelector(".arithmatex")) return;
  window.MathJax = {
    tex: {
      inlineMath: [["\\(", "\\)"]],
      displayMath: [["\\[", "\\]"]],
      processEscapes: true,
    },
    options: { ignoreHtmlClass: ".*|", processHtmlClass: "arithmatex" },
  };
  const script = document.createElement("script");
  script.src = "https://cdn.jsdelivr.net/npm/mathjax@3/es5/tex-chtml.js";
  script.async = true;
  document.head.append(script);
});
